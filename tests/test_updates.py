"""SAC, TD3 and PPO against plain ones: written out here in the ordinary way, as CleanRL does.

The plain ones take over the scripts' initial weights and draw the same random numbers in the same
order; they share nothing else, so equal final weights mean equal algorithms.
"""

import copy
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch
import torch.nn as nn
import torch.nn.functional as F
from gymnasium import wrappers
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.distributions import Normal

import ppo_continuous_noisy as ppo
import sac_continuous_noisy as sac
import td3_continuous_noisy as td3
from noisy_wrappers import (
    RandomEarlyTermination,
    RandomNormalNoisyReward,
    RandomUniformNoisyObservation,
)

ENV = "toy_envs:Tiny-v0"
SMALL = {"env_id": ENV, "seed": 3, "eval_episodes": 1, "eval_frequency": 7, "compile": False}
SMALL |= {"matmul_precision": "highest", "gamma": 0.9}
OFF_POLICY = SMALL | {"total_timesteps": 70, "learning_starts": 30, "buffer_size": 40}
OFF_POLICY |= {"batch_size": 12, "tau": 0.1}
ON_POLICY = SMALL | {"total_timesteps": 100, "num_steps": 32, "num_minibatches": 4}
ON_POLICY |= {"update_epochs": 3, "learning_rate": 1e-3}
NOISE = {
    "noise": (
        "RandomNormalNoisyReward(0.5)",
        "RandomUniformNoisyObservation(-0.1, 0.3)",
        "RandomEarlyTermination(2, 4)",
    ),
    "noise_rate": (0.5, 0.3, 0.4),
}


def make_env(args):
    env = gym.make(args.env_id)
    if args.noise:
        env = RandomEarlyTermination(env, 0.4, 2, 4)
        env = RandomNormalNoisyReward(env, 0.5, 0.5)
        env = RandomUniformNoisyObservation(env, 0.3, -0.1, 0.3)
    return env


def ordinary(state, activation=nn.ReLU):
    """Return trainable networks of three layers each with the weights of a state_dict."""
    values = [v.detach().clone() for k, v in state.items() if k.endswith((".weight", ".bias"))]
    networks = []
    for i in range(0, len(values), 6):
        layers = []
        for weight, bias in zip(values[i : i + 6 : 2], values[i + 1 : i + 6 : 2], strict=True):
            with torch.random.fork_rng():
                layer = nn.Linear(*reversed(weight.shape))
            layer.weight, layer.bias = nn.Parameter(weight), nn.Parameter(bias)
            layers += [layer, activation()]
        networks.append(nn.Sequential(*layers[:-1]))
    return networks


def parameters(*networks):
    return [p for network in networks for p in network.parameters()]


def q_value(network, observations, actions):
    return network(torch.cat([observations, actions], 1)).view(-1)


def soft_update(networks, targets, tau):
    for param, target_param in zip(parameters(*networks), parameters(*targets), strict=True):
        target_param.data.copy_(tau * param.data + (1 - tau) * target_param.data)


def minimize(optimizer, loss):
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()


def sample(transitions, batch_size, rng):
    rows = [transitions[i] for i in rng.integers(len(transitions), size=batch_size)]
    columns = zip(*rows, strict=True)
    return [torch.tensor(np.array(column), dtype=torch.float32) for column in columns]


def random_batch(env, size):
    """Return a batch in float64: s, a, r, s', terminated."""
    batch = [torch.randn(size, 3), torch.randn(size, 2), torch.randn(size), torch.randn(size, 3)]
    return [x.double() for x in (*batch, torch.arange(size) % 3 == 0)]


class PlainSAC:
    def __init__(self, actor, critic, target, space, args, log_alpha=0.0):
        [self.actor] = ordinary(actor)
        self.q1, self.q2 = ordinary(critic)
        self.q1_target, self.q2_target = ordinary(target)
        low, high = torch.tensor(space.low), torch.tensor(space.high)
        self.scale, self.bias = (high - low) / 2, (high + low) / 2
        self.args, self.target_entropy = args, -2.0
        self.log_alpha = torch.full((1,), log_alpha, dtype=self.actor[0].weight.dtype, requires_grad=True)
        self.alpha = self.log_alpha.exp().item() if args.autotune else args.alpha
        self.q_optimizer = torch.optim.Adam(parameters(self.q1, self.q2), lr=args.q_lr)
        self.actor_optimizer = torch.optim.Adam(self.actor.parameters(), lr=args.policy_lr)
        self.a_optimizer = torch.optim.Adam([self.log_alpha], lr=args.q_lr)

    def get_action(self, observations):
        mean, log_std = self.actor(observations).chunk(2, dim=1)
        log_std = torch.tanh(log_std)
        log_std = -5 + 0.5 * (2 - -5) * (log_std + 1)
        normal = Normal(mean, log_std.exp())
        x = normal.rsample()
        y = torch.tanh(x)
        log_prob = normal.log_prob(x) - torch.log(self.scale * (1 - y.pow(2)) + 1e-6)
        return y * self.scale + self.bias, log_prob.sum(1)

    def critic_loss(self, batch):
        observations, actions, rewards, next_observations, terminated = batch
        with torch.no_grad():
            next_actions, next_log_pi = self.get_action(next_observations)
            q1_next = q_value(self.q1_target, next_observations, next_actions)
            q2_next = q_value(self.q2_target, next_observations, next_actions)
            next_value = torch.min(q1_next, q2_next) - self.alpha * next_log_pi
            y = rewards + (1 - terminated) * self.args.gamma * next_value
        q1_loss = F.mse_loss(q_value(self.q1, observations, actions), y)
        return q1_loss + F.mse_loss(q_value(self.q2, observations, actions), y)

    def actor_loss(self, observations):
        actions, log_pi = self.get_action(observations)
        q1, q2 = q_value(self.q1, observations, actions), q_value(self.q2, observations, actions)
        return (self.alpha * log_pi - torch.min(q1, q2)).mean()

    def alpha_loss(self, observations):
        with torch.no_grad():
            _, log_pi = self.get_action(observations)
        return (-self.log_alpha.exp() * (log_pi + self.target_entropy)).mean()

    def learn(self, step, batch):
        minimize(self.q_optimizer, self.critic_loss(batch))
        if step % self.args.policy_frequency == 0:
            for _ in range(self.args.policy_frequency):
                minimize(self.actor_optimizer, self.actor_loss(batch[0]))
                if self.args.autotune:
                    minimize(self.a_optimizer, self.alpha_loss(batch[0]))
                    self.alpha = self.log_alpha.exp().item()
        if step % self.args.target_network_frequency == 0:
            soft_update([self.q1, self.q2], [self.q1_target, self.q2_target], self.args.tau)

    def act(self, observation):
        with torch.no_grad():
            return self.get_action(torch.Tensor(observation)[None])[0][0].numpy()


class PlainTD3:
    def __init__(self, actor, critic, target_actor, target_critic, space, args):
        [self.actor], [self.actor_target] = ordinary(actor), ordinary(target_actor)
        self.q1, self.q2 = ordinary(critic)
        self.q1_target, self.q2_target = ordinary(target_critic)
        self.low, self.high = torch.tensor(space.low), torch.tensor(space.high)
        self.scale, self.bias = (self.high - self.low) / 2, (self.high + self.low) / 2
        self.args = args
        self.q_optimizer = torch.optim.Adam(parameters(self.q1, self.q2), lr=args.learning_rate)
        self.actor_optimizer = torch.optim.Adam(self.actor.parameters(), lr=args.learning_rate)

    def action(self, actor, observations):
        return torch.tanh(actor(observations)) * self.scale + self.bias

    def critic_loss(self, batch):
        observations, actions, rewards, next_observations, terminated = batch
        with torch.no_grad():
            noise = torch.randn_like(actions) * self.args.policy_noise
            noise = noise.clamp(-self.args.noise_clip, self.args.noise_clip) * self.scale
            next_actions = self.action(self.actor_target, next_observations) + noise
            next_actions = torch.max(torch.min(next_actions, self.high), self.low)
            q1_next = q_value(self.q1_target, next_observations, next_actions)
            q2_next = q_value(self.q2_target, next_observations, next_actions)
            y = rewards + (1 - terminated) * self.args.gamma * torch.min(q1_next, q2_next)
        q1_loss = F.mse_loss(q_value(self.q1, observations, actions), y)
        return q1_loss + F.mse_loss(q_value(self.q2, observations, actions), y)

    def actor_loss(self, observations):
        return -q_value(self.q1, observations, self.action(self.actor, observations)).mean()

    def learn(self, step, batch):
        minimize(self.q_optimizer, self.critic_loss(batch))
        if step % self.args.policy_frequency == 0:
            minimize(self.actor_optimizer, self.actor_loss(batch[0]))
            online = [self.actor, self.q1, self.q2]
            targets = [self.actor_target, self.q1_target, self.q2_target]
            soft_update(online, targets, self.args.tau)

    def act(self, observation):
        with torch.no_grad():
            action = self.action(self.actor, torch.Tensor(observation))
            action += torch.randn(2) * self.scale * self.args.exploration_noise
        return action.numpy().clip(self.low.numpy(), self.high.numpy())


def plain_training(plain, env, args):
    """Train until the first end of an episode after total_timesteps; return the ends so far."""
    transitions, ends, step = [], [], 0
    rng = np.random.default_rng(args.seed)
    env.action_space.seed(args.seed)
    observation, _ = env.reset(seed=args.seed)
    while True:
        step += 1
        random = step <= args.learning_starts
        action = env.action_space.sample() if random else plain.act(observation)
        next_observation, reward, terminated, truncated, _ = env.step(action)
        transitions.append((observation, action, reward, next_observation, terminated))
        transitions = transitions[-args.buffer_size :]
        if not random:
            plain.learn(step, sample(transitions, args.batch_size, rng))
        observation = next_observation
        if terminated or truncated:
            ends.append("terminated" if terminated else "truncated")
            if step > args.total_timesteps:
                return ends
            observation, _ = env.reset()


def checkpoint(script, args, episodes, tmp_path):
    """Stop the script after so many episodes and return its checkpoint, which holds everything."""
    ends = iter(range(1, 1000))
    args = replace(args, runs_dir=str(tmp_path), total_timesteps=1000)
    assert not script.train(args, stop=lambda: next(ends) == episodes)
    [path] = tmp_path.glob("*/checkpoint.pt")
    return torch.load(path, weights_only=True)


def assert_equal_networks(state, *networks):
    actual, expected = parameters(*ordinary(state)), parameters(*networks)
    print([f"{((a - b).norm() / b.norm()).item():.1e}" for a, b in zip(actual, expected)])
    torch.testing.assert_close(actual, expected, rtol=0, atol=2e-5)


@pytest.mark.parametrize(
    "case",
    [
        {},
        {"autotune": False, "alpha": 0.4},
        {"policy_frequency": 3, "target_network_frequency": 2, "q_lr": 3e-3, **NOISE},
    ],
)
def test_sac_trains_as_a_plain_implementation(case, tmp_path):
    args = sac.Args(**OFF_POLICY | case)
    env = make_env(args)
    torch.manual_seed(args.seed)
    actor, critic, _ = sac.Actor(env), sac.Critic(env), sac.Critic(env)
    actor, critic = actor.state_dict(), critic.state_dict()
    plain = PlainSAC(actor, critic, critic, env.action_space, args)
    ends = plain_training(plain, env, args)
    assert {"terminated", "truncated"} == set(ends)  # or this shows less than it seems to

    state = checkpoint(sac, args, len(ends), tmp_path)
    assert_equal_networks(state["actor"], plain.actor)
    assert_equal_networks(state["critic"], plain.q1, plain.q2)
    assert_equal_networks(state["target"], plain.q1_target, plain.q2_target)
    alpha = state["temperature"]["log_alpha"].exp().item()
    assert alpha == pytest.approx(plain.alpha, abs=1e-6)
    assert (alpha != args.alpha) == args.autotune


@pytest.mark.parametrize(
    "case",
    [
        {},
        {"policy_frequency": 3, "policy_noise": 1.0, "noise_clip": 0.7, "exploration_noise": 0.8},
        {"policy_frequency": 1, "learning_rate": 3e-3, **NOISE},
    ],
)
def test_td3_trains_as_a_plain_implementation(case, tmp_path):
    args = td3.Args(**OFF_POLICY | case)
    env = make_env(args)
    torch.manual_seed(args.seed)
    actor, critic = td3.Actor(env).state_dict(), td3.Critic(env).state_dict()
    td3.Actor(env), td3.Critic(env)
    plain = PlainTD3(actor, critic, actor, critic, env.action_space, args)
    ends = plain_training(plain, env, args)
    assert {"terminated", "truncated"} == set(ends)

    state = checkpoint(td3, args, len(ends), tmp_path)
    assert_equal_networks(state["actor"], plain.actor)
    assert_equal_networks(state["critic"], plain.q1, plain.q2)
    assert_equal_networks(state["target_actor"], plain.actor_target)
    assert_equal_networks(state["target_critic"], plain.q1_target, plain.q2_target)
