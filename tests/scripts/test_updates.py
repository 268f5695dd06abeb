"""SAC, TD3 and PPO against plain ones: written out here in the ordinary way, as CleanRL does.

The plain ones take over the scripts' initial weights and draw the same random numbers in the same
order; they share nothing else, so equal final weights mean equal algorithms.
"""

import copy
import signal
from dataclasses import replace
from types import SimpleNamespace
from unittest import mock

import gymnasium as gym
import numpy as np
import pytest
import torch
import torch._inductor.config
import torch.nn as nn
import torch.nn.functional as F
from gymnasium import wrappers
from small_runs import SCRIPTS, curves, refused, slow, two_scripts
from torch.distributions import Normal

import noisy_wrappers as noisy
import ppo_continuous_noisy as ppo
import sac_continuous_noisy as sac
import td3_continuous_noisy as td3

ENV = "toy_envs:Tiny-v0"
SMALL = {"env_id": ENV, "seed": 3, "eval_episodes": 1, "eval_frequency": 7, "compile": False}
SMALL |= {"matmul_precision": "highest", "gamma": 0.9}
OFF_POLICY = SMALL | {"total_timesteps": 55, "learning_starts": 30, "buffer_size": 40}
OFF_POLICY |= {"batch_size": 12, "tau": 0.1}
ON_POLICY = SMALL | {"total_timesteps": 100, "num_steps": 32, "num_minibatches": 4}
ON_POLICY |= {"update_epochs": 3, "learning_rate": 1e-3}
NOISES = ("RandomEarlyTermination(2, 4)", "RandomNormalNoisyReward(0.5)")
NOISES += ("RandomUniformNoisyObservation(-0.1, 0.3)",)
NOISE = {"noise": NOISES, "noise_rate": (0.4, 0.5, 0.3)}


def make_env(args):
    return noisy.make_noisy(gym.make(args.env_id), args.noise, args.noise_rate)


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


class PlainBuffer:
    """Whole transitions in a ring of rows; an end of an episode is followed by an empty row."""

    def __init__(self, rows):
        self.rows, self.stored, self.next = rows, {}, 0

    def add(self, transition, ended):
        self.stored[self.next], self.next = transition, (self.next + 1) % self.rows
        self.stored[self.next] = None
        self.next = (self.next + ended) % self.rows

    def sample(self, batch_size, rng):
        rows = [None] * batch_size
        while None in rows:
            drawn = rng.integers(len(self.stored), size=batch_size)
            rows = [row or self.stored[i] for row, i in zip(rows, drawn, strict=True)]
        return [torch.tensor(np.array(column), dtype=torch.float32) for column in zip(*rows)]  # noqa: B905


class PlainActorCritic:
    """What SAC and TD3 have in common."""

    def __init__(self, actor, critic, target, space, args):
        [self.actor] = ordinary(actor)
        self.q1, self.q2 = ordinary(critic)
        self.q1_target, self.q2_target = ordinary(target)
        self.low, self.high = torch.tensor(space.low), torch.tensor(space.high)
        self.scale, self.bias = (self.high - self.low) / 2, (self.high + self.low) / 2
        self.args = args

    def critic_loss(self, batch):
        observations, actions, rewards, next_observations, terminated = batch
        with torch.no_grad():
            next_actions, bonus = self.next_actions(next_observations)
            q1_next = q_value(self.q1_target, next_observations, next_actions)
            q2_next = q_value(self.q2_target, next_observations, next_actions)
            next_value = torch.min(q1_next, q2_next) + bonus
            y = rewards + (1 - terminated) * self.args.gamma * next_value
        q1_loss = F.mse_loss(q_value(self.q1, observations, actions), y)
        return q1_loss + F.mse_loss(q_value(self.q2, observations, actions), y)


class PlainSAC(PlainActorCritic):
    def __init__(self, actor, critic, target, space, args):
        super().__init__(actor, critic, target, space, args)
        self.target_entropy = -2.0
        self.log_alpha = torch.zeros(1, requires_grad=True)
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

    def next_actions(self, next_observations):
        next_actions, next_log_pi = self.get_action(next_observations)
        return next_actions, -self.alpha * next_log_pi

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


class PlainTD3(PlainActorCritic):
    def __init__(self, actor, critic, space, args):
        super().__init__(actor, critic, critic, space, args)
        [self.actor_target] = ordinary(actor)
        self.q_optimizer = torch.optim.Adam(parameters(self.q1, self.q2), lr=args.learning_rate)
        self.actor_optimizer = torch.optim.Adam(self.actor.parameters(), lr=args.learning_rate)

    def action(self, actor, observations):
        return torch.tanh(actor(observations)) * self.scale + self.bias

    def next_actions(self, next_observations):
        noise = torch.randn(len(next_observations), 2) * self.args.policy_noise
        noise = noise.clamp(-self.args.noise_clip, self.args.noise_clip) * self.scale
        next_actions = self.action(self.actor_target, next_observations) + noise
        return torch.max(torch.min(next_actions, self.high), self.low), 0.0

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
    """Train until the first end of an episode after total_timesteps; return how many there were."""
    buffer, ends, step = PlainBuffer(args.buffer_size + 1), [], 0
    rng = np.random.default_rng(args.seed)
    env.action_space.seed(args.seed)
    observation, _ = env.reset(seed=args.seed)
    while True:
        step += 1
        random = step <= args.learning_starts
        action = env.action_space.sample() if random else plain.act(observation)
        next_observation, reward, terminated, truncated, _ = env.step(action)
        transition = (observation, action, reward, next_observation, terminated)
        buffer.add(transition, terminated or truncated)
        if not random:
            plain.learn(step, buffer.sample(args.batch_size, rng))
        observation = next_observation
        if terminated or truncated:
            ends.append("terminated" if terminated else "truncated")
            if step > args.total_timesteps:
                assert {"terminated", "truncated"} == set(ends)  # or tests show less than it seems
                return len(ends)
            observation, _ = env.reset()


def checkpoint(script, args, episodes, tmp_path):
    """Stop the script after so many episodes; return the state in its checkpoint."""
    ends = iter(range(1, 1000))
    args = replace(args, runs_dir=str(tmp_path), total_timesteps=1000)
    assert not script.train(args, stop=lambda: next(ends) == episodes)
    [path] = tmp_path.glob("*/checkpoint.pt")
    return script.read_state(path)["state"]


def assert_equal_networks(state, *networks):
    actual = nn.utils.parameters_to_vector(parameters(*ordinary(state)))
    expected = nn.utils.parameters_to_vector(parameters(*networks))
    # rounding alone gives 4e-7; one update left out, for one bias, some 1e-4
    assert (actual - expected).norm() < 5e-6 * expected.norm()


FIXED = {"autotune": False, "alpha": 0.4}
SELDOM = {"policy_frequency": 3, "target_network_frequency": 2, "q_lr": 3e-3, **NOISE}


@pytest.mark.parametrize("case", [slow(FIXED), SELDOM])
def test_sac_trains_as_a_plain_implementation(case, tmp_path):
    args = sac.Args(**OFF_POLICY | case)
    env = make_env(args)
    torch.manual_seed(args.seed)
    actor, critic, _ = sac.Actor(env), sac.Critic(env), sac.Critic(env)
    actor, critic = actor.state_dict(), critic.state_dict()
    plain = PlainSAC(actor, critic, critic, env.action_space, args)
    state = checkpoint(sac, args, plain_training(plain, env, args), tmp_path)
    assert_equal_networks(state["actor"], plain.actor)
    assert_equal_networks(state["critic"], plain.q1, plain.q2)
    assert_equal_networks(state["target"], plain.q1_target, plain.q2_target)
    alpha = state["temperature"]["log_alpha"].exp().item()
    assert alpha == pytest.approx(plain.alpha, abs=1e-6)
    assert (alpha != pytest.approx(args.alpha)) == args.autotune


LOUD = {"policy_frequency": 3, "policy_noise": 1.0, "noise_clip": 0.7, "exploration_noise": 0.8}
OFTEN = {"policy_frequency": 1, "learning_rate": 1e-3, **NOISE}


@pytest.mark.parametrize("case", [slow(LOUD), OFTEN])
def test_td3_trains_as_a_plain_implementation(case, tmp_path):
    args = td3.Args(**OFF_POLICY | case)
    env = make_env(args)
    torch.manual_seed(args.seed)
    actor, critic = td3.Actor(env).state_dict(), td3.Critic(env).state_dict()
    td3.Actor(env), td3.Critic(env)
    plain = PlainTD3(actor, critic, env.action_space, args)
    state = checkpoint(td3, args, plain_training(plain, env, args), tmp_path)
    assert_equal_networks(state["actor"], plain.actor)
    assert_equal_networks(state["critic"], plain.q1, plain.q2)
    assert_equal_networks(state["target_actor"], plain.actor_target)
    assert_equal_networks(state["target_critic"], plain.q1_target, plain.q2_target)


class PlainPPO(nn.Module):
    def __init__(self, agent, args):
        super().__init__()
        self.critic, self.actor_mean = ordinary(agent, nn.Tanh)
        self.actor_logstd = nn.Parameter(agent["actor_logstd"].detach().clone())
        self.args = args
        self.optimizer = torch.optim.Adam(self.parameters(), lr=args.learning_rate, eps=1e-5)

    def forward(self, observations, actions):
        probs = Normal(self.actor_mean(observations), self.actor_logstd.exp())
        entropy = probs.entropy().sum(1)
        return probs.log_prob(actions).sum(1), entropy, self.critic(observations).view(-1)

    def loss(self, minibatch):
        args = self.args
        observations, actions, old_logprobs, advantages, returns, old_values = minibatch
        logprobs, entropy, values = self(observations, actions)
        logratio = logprobs - old_logprobs
        ratio = logratio.exp()
        self.approx_kl = ((ratio - 1) - logratio).mean().item()
        if args.norm_adv:
            advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        pg_loss1 = -advantages * ratio
        pg_loss2 = -advantages * torch.clamp(ratio, 1 - args.clip_coef, 1 + args.clip_coef)
        v_loss = (values - returns) ** 2
        if args.clip_vloss:
            clipped = torch.clamp(values - old_values, -args.clip_coef, args.clip_coef)
            v_loss = torch.max(v_loss, (old_values + clipped - returns) ** 2)
        v_loss = 0.5 * v_loss.mean()
        pg_loss = torch.max(pg_loss1, pg_loss2).mean()
        return pg_loss - args.ent_coef * entropy.mean() + args.vf_coef * v_loss

    def learn(self, minibatch):
        self.optimizer.zero_grad()
        self.loss(minibatch).backward()
        nn.utils.clip_grad_norm_(self.parameters(), self.args.max_grad_norm)
        self.optimizer.step()


def plain_ppo_training(plain, env, args):
    """Train in CleanRL's stack of wrappers; return the environment and the epochs of rollouts."""
    env = wrappers.ClipAction(env)
    env = normalizing = wrappers.NormalizeObservation(env)
    env = wrappers.TransformObservation(env, lambda x: np.clip(x, -10, 10), None)
    env = wrappers.NormalizeReward(env, gamma=args.gamma)
    env = wrappers.TransformReward(env, lambda reward: np.clip(reward, -10, 10))
    T, rng, ends, epochs = args.num_steps, np.random.default_rng(args.seed), set(), []
    next_obs, _ = env.reset(seed=args.seed)
    next_done = 0.0
    iterations = args.total_timesteps // T
    for iteration in range(1, iterations + 1):
        if args.anneal_lr:
            frac = 1.0 - (iteration - 1.0) / iterations
            plain.optimizer.param_groups[0]["lr"] = frac * args.learning_rate
        obs, actions = torch.zeros(T, 3), torch.zeros(T, 2)
        logprobs, rewards, dones, values = torch.zeros(4, T)
        noise = torch.randn(T, 2)  # all at once, then action = mean + std * noise
        for step in range(T):
            obs[step], dones[step] = torch.Tensor(next_obs), next_done
            with torch.no_grad():
                mean, std = plain.actor_mean(obs[step]), plain.actor_logstd.exp()
                actions[step] = mean + std * noise[step]
                logprob, _, value = plain(obs[step][None], actions[step][None])
            logprobs[step], values[step] = logprob, value
            next_obs, reward, terminated, truncated, _ = env.step(actions[step].numpy())
            next_done = float(terminated or truncated)
            if truncated and not terminated and args.bootstrap_truncated:
                reward += args.gamma * plain.critic(torch.Tensor(next_obs)).item()
            rewards[step] = reward
            if next_done:
                ends.add("terminated" if terminated else "truncated")
            # nothing is observed after the last step: the policy's statistics are the tested ones
            if next_done and (iteration < iterations or step < T - 1):
                next_obs, _ = env.reset()

        with torch.no_grad():
            next_value = plain.critic(torch.Tensor(next_obs)).item()
            advantages, lastgaelam = torch.zeros(T), 0
            for t in reversed(range(T)):
                nextnonterminal = 1.0 - (next_done if t == T - 1 else dones[t + 1])
                nextvalue = next_value if t == T - 1 else values[t + 1]
                delta = rewards[t] + args.gamma * nextvalue * nextnonterminal - values[t]
                lastgaelam = delta + args.gamma * args.gae_lambda * nextnonterminal * lastgaelam
                advantages[t] = lastgaelam
            returns = advantages + values

        batch = (obs, actions, logprobs, advantages, returns, values)
        for epoch in range(args.update_epochs):  # noqa: B007
            order = rng.permutation(T)
            for indices in np.array_split(order, args.num_minibatches):
                plain.learn([tensor[indices] for tensor in batch])
            if args.target_kl is not None and plain.approx_kl > args.target_kl:
                break
        epochs.append(epoch + 1)
    assert {"terminated", "truncated"} == ends
    return normalizing, epochs


LOOSE = {"num_minibatches": 5, "norm_adv": False, "clip_vloss": False, "anneal_lr": False}
LOOSE |= {"max_grad_norm": 100.0}
TIGHT = {"bootstrap_truncated": True, "clip_coef": 0.02, "vf_coef": 1.0, "max_grad_norm": 0.1}
STOPS = {"target_kl": 0.004, "learning_rate": 3e-3}


@pytest.mark.parametrize("case", [slow({"ent_coef": 0.01}), slow(LOOSE), TIGHT, STOPS | NOISE])
def test_ppo_trains_as_a_plain_implementation(case, tmp_path):
    args = ppo.Args(**ON_POLICY | case)
    env = make_env(args)
    torch.manual_seed(args.seed)
    plain = PlainPPO(ppo.Agent(env).state_dict(), args)
    normalizing, epochs = plain_ppo_training(plain, env, args)
    assert (min(epochs) < args.update_epochs) == (args.target_kl is not None)

    assert ppo.train(replace(args, runs_dir=str(tmp_path)))
    [path] = tmp_path.glob("*/policy.pt")
    state = ppo.read_state(path)
    assert_equal_networks(state["agent"], plain.critic, plain.actor_mean)
    logstd = state["agent"]["actor_logstd"]
    torch.testing.assert_close(logstd, plain.actor_logstd.data, rtol=0, atol=1e-6)
    stats, expected = state["observation_stats"], normalizing.obs_rms
    np.testing.assert_allclose(stats["mean"], expected.mean, rtol=1e-6)
    np.testing.assert_allclose(stats["var"], expected.var, rtol=1e-6)
    assert stats["count"] == pytest.approx(expected.count)


def test_ppo_anneals_every_learning_rate(tmp_path, monkeypatch):
    """Also one that a changed script gives to a part of the agent."""
    made, adam = [], torch.optim.Adam

    def with_two_rates(parameters, **options):
        first, *others = parameters
        made.append(adam([{"params": first}, {"params": others, "lr": 1e-3}], **options))
        return made[-1]

    monkeypatch.setattr(torch.optim, "Adam", with_two_rates)
    args = ppo.Args(**ON_POLICY, runs_dir=str(tmp_path))
    assert ppo.train(args)
    rollouts = args.total_timesteps // args.num_steps
    rates = [group["lr"] for group in made[0].param_groups]
    assert rates == pytest.approx([args.learning_rate / rollouts, 1e-3 / rollouts])
    [folder] = tmp_path.iterdir()
    shown = [float(value) for _, value in curves(folder)["charts/learning_rate"]]
    assert shown == pytest.approx(args.learning_rate * np.arange(rollouts, 0, -1) / rollouts)


# LOSSES: Adam hides a factor of a whole loss, and nobody else reads the curves.


def random_batch(size):
    """Return s, a, r, s', terminated."""
    batch = [torch.randn(size, 3), torch.randn(size, 2), torch.randn(size), torch.randn(size, 3)]
    return [*batch, (torch.arange(size) % 3 == 0).float()]


def test_every_curve_is_logged_whatever_the_policy_frequency(tmp_path):
    args = sac.Args(**OFF_POLICY | {"total_timesteps": 55, "policy_frequency": 3})
    sac.train(replace(args, runs_dir=str(tmp_path)))  # the last update of the actor is at step 54
    assert [step for step, _ in curves(next(tmp_path.iterdir()))["losses/actor_loss"]] == [55]


def assert_curves(curves, **expected):
    found = {name: curves[name] for name in expected}
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-6)


def test_losses_of_sac_and_their_curves():
    torch.manual_seed(0)
    env, args, batch = gym.make(ENV), sac.Args(gamma=0.9), random_batch(64)
    actor, critic, target = sac.Actor(env), sac.Critic(env), sac.Critic(env)
    temperature = nn.ParameterDict({"log_alpha": torch.tensor(0.0)})
    states = (network.state_dict() for network in (actor, critic, target))
    plain, eps = PlainSAC(*states, env.action_space, args), torch.randn(64, 2)

    def expected(loss, *arguments):
        """Call a loss so that rsample() draws `eps`."""
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("torch.distributions.normal._standard_normal", lambda *_, **__: eps)
            return loss(*arguments)

    loss, curves = sac.critic_loss(critic, target, actor, temperature, batch, eps, args.gamma)
    torch.testing.assert_close(loss, expected(plain.critic_loss, batch))
    q1, q2 = q_value(plain.q1, *batch[:2]), q_value(plain.q2, *batch[:2])
    assert_curves(curves, qf1_values=q1.mean(), qf2_values=q2.mean(), qf_loss=loss / 2)
    torch.testing.assert_close(curves["qf1_loss"] + curves["qf2_loss"], loss)
    _, curves = sac.actor_loss(actor, critic, temperature, batch[0], eps)
    assert_curves(curves, actor_loss=expected(plain.actor_loss, batch[0]), alpha=torch.tensor(1.0))
    _, curves = sac.temperature_loss(temperature, actor, batch[0], eps, -2.0)
    assert_curves(curves, alpha_loss=expected(plain.alpha_loss, batch[0]))


def test_losses_of_td3_and_their_curves():
    torch.manual_seed(0)
    env, batch, eps = gym.make(ENV), random_batch(64), 0.1 * torch.randn(64, 2)
    actor, critic, target = td3.Actor(env), td3.Critic(env), td3.Critic(env)
    next_values = torch.stack(target(batch[3], actor(batch[3], eps))).amin(0)
    y = batch[2] + 0.9 * (1 - batch[4]) * next_values
    q1, q2 = critic(*batch[:2])
    losses = [nn.functional.mse_loss(q, y) for q in (q1, q2)]
    loss, curves = td3.critic_loss(critic, target, actor, batch, eps, 0.9)
    torch.testing.assert_close(loss, sum(losses))
    assert_curves(curves, qf1_values=q1.mean(), qf2_values=q2.mean(), qf_loss=sum(losses) / 2)
    assert_curves(curves, qf1_loss=losses[0], qf2_loss=losses[1])
    loss, curves = td3.actor_loss(actor, critic, batch[0])
    assert_curves(curves, actor_loss=-critic(batch[0], actor(batch[0]))[0].mean())
    torch.testing.assert_close(loss, curves["actor_loss"])


def test_the_loss_of_ppo_and_its_curves():
    torch.manual_seed(0)
    args, agent = ppo.Args(ent_coef=0.01), ppo.Agent(gym.make(ENV))
    agent.actor_logstd.data += torch.tensor([-0.5, 0.2])
    plain = PlainPPO(agent.state_dict(), args)
    observations, actions, advantages, _, _ = random_batch(64)
    log_probs, entropy, values = plain(observations, actions)
    old_log_probs = log_probs.detach() + 0.3 * torch.randn(64)
    old_values = values.detach() + 0.3 * torch.randn(64)
    minibatch = (observations, actions, old_log_probs, advantages, old_values + 1, old_values)
    loss, curves = ppo.ppo_loss(agent, minibatch, args)
    torch.testing.assert_close(loss, plain.loss(minibatch))
    ratio = (log_probs - old_log_probs).exp()
    clipped = ((ratio - 1).abs() > 0.2).float()
    assert_curves(curves, clipfrac=clipped.mean(), old_approx_kl=-ratio.log().mean())
    assert_curves(curves, approx_kl=torch.tensor(plain.approx_kl), entropy=entropy.mean())
    parts = curves["policy_loss"] - 0.01 * curves["entropy"] + 0.5 * curves["value_loss"]
    torch.testing.assert_close(parts, loss)
    scaled = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
    policy_loss = -torch.minimum(scaled * ratio, scaled * ratio.clamp(0.8, 1.2)).mean()
    assert_curves(curves, policy_loss=policy_loss)


# UPDATES


def loss_of_a_researcher(network, other, x, coefficient):
    """Use the learned network and another one, in several ways."""
    distance = (network(x) - other(network(x))).square().mean()
    return distance + coefficient * network[0].weight.square().sum() + other[0].weight.sum(), {}


def two_networks():
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(3, 4), nn.Tanh(), nn.Linear(4, 3))
    return network, copy.deepcopy(network), torch.randn(5, 3)


def learned(script, compile, coefficients):
    """Return the weights after an update with each of these numbers."""
    network, other, x = two_networks()
    optimizer = torch.optim.SGD(network.parameters(), lr=0.1)
    args = script.Args(compile=compile)
    update = script.updater(loss_of_a_researcher, network, optimizer, args)
    for coefficient in coefficients:
        with torch.no_grad():
            update(other, x, coefficient)
    return network.state_dict()


@two_scripts
def test_each_term_of_a_loss_has_its_gradient_and_other_networks_are_constants(algorithm):
    script, (network, other, x) = SCRIPTS[algorithm], two_networks()
    network[0].bias.requires_grad_(False)  # frozen
    thawed = [p for p in network.parameters() if p.requires_grad]
    optimizer = torch.optim.SGD(thawed, lr=1.0)  # any optimizer
    loss, _ = loss_of_a_researcher(network, other, x, 0.3)
    gradients = torch.autograd.grad(loss, thawed)
    expected = [p.detach() - g for p, g in zip(thawed, gradients, strict=True)]
    args = script.Args(compile=False)
    args.max_grad_norm = 1e9
    script.updater(loss_of_a_researcher, network, optimizer, args)(other, x, 0.3)
    torch.testing.assert_close([p.detach() for p in thawed], expected)
    assert all(p.grad is None for p in [*parameters(other), network[0].bias])


@two_scripts
def test_a_layer_may_be_frozen_and_thawed_while_it_learns(algorithm):
    script, (network, other, x) = SCRIPTS[algorithm], two_networks()
    optimizer = torch.optim.Adam(network.parameters())  # its momentum would move a frozen layer
    update = script.updater(loss_of_a_researcher, network, optimizer, script.Args(compile=False))
    for frozen in (False, True, False):
        network[0].requires_grad_(not frozen)
        before = copy.deepcopy(network.state_dict())
        update(other, x, 0.3)
        moved = [name for name, p in network.state_dict().items() if not p.equal(before[name])]
        assert moved == [*before][2 * frozen :]


@pytest.fixture
def graphs(monkeypatch):
    """Let torch.compile make graphs that are not translated, so without a compiler; list them."""
    found, real = [], torch.compile

    def backend(graph, inputs):
        found.append(graph)
        return graph

    monkeypatch.setattr(torch, "compile", lambda f, **kwargs: real(f, backend=backend, **kwargs))
    torch.compiler.reset()
    return found


@pytest.mark.slow
@two_scripts
def test_numbers_given_to_an_update_do_not_recompile(algorithm, graphs):
    numbers = (0.5, 1, 0, np.float64(0.25), *np.linspace(0, 1, 10))
    compiled, plain = (learned(SCRIPTS[algorithm], compile, numbers) for compile in (True, False))
    assert len(graphs) == 1
    torch.testing.assert_close(compiled, plain)


@pytest.mark.slow
def test_a_script_may_have_many_updates(graphs):
    """PyTorch compiles one function eight times at most; here each update has this for itself."""
    args = sac.Args()

    def loss(network, x):
        return network(x).sum(), {}

    for _ in range(10):
        network, _, x = two_networks()
        sac.updater(loss, network, torch.optim.SGD(network.parameters()), args)(x)
    assert len(graphs) == 10


@pytest.mark.slow
def test_a_number_of_args_that_changes_too_often_says_what_to_do(graphs, capsys):
    args, (network, _, x) = ppo.Args(), two_networks()

    def loss(network, x, args):
        return args.ent_coef * network(x).sum(), {}

    update = ppo.updater(loss, network, torch.optim.SGD(network.parameters()), args)

    def anneal():
        for step in range(20):
            args.ent_coef = step / 20
            update(x, args)

    assert "changes too often: pass it to the update" in refused(capsys, anneal, code=1)
    assert 1 < len(graphs) < 20


@pytest.mark.slow
@torch._inductor.config.patch({"cpp.cxx": (None, "/no/compiler"), "force_disable_caches": True})
def test_what_cannot_be_compiled_is_computed_without(capsys):
    torch.compiler.reset()
    compiled, plain = (learned(sac, compile, 3 * [0.3]) for compile in (True, False))
    out = capsys.readouterr().out
    assert out.startswith("not compiled, so it is slower: ") and "/no/compiler" in out
    assert "the compiler's cache is " in out and out.count("\n") == 1
    torch.testing.assert_close(compiled, plain, rtol=0, atol=0)


@pytest.mark.slow
def test_numbers_of_numpy_in_a_loss_are_computed_without_the_compiler(capsys):
    network, _, x = two_networks()
    scale = [np.float64(2)]

    def loss(network, x):
        return scale[0] * network(x).sum(), {}

    args = sac.Args()
    sac.updater(loss, network, torch.optim.SGD(network.parameters()), args)(x)
    out = capsys.readouterr().out
    assert out.startswith("not compiled, so it is slower: ") and "InvalidCxx" not in out


@pytest.mark.parametrize("script", SCRIPTS.values())
def test_an_optimizer_steps_only_what_its_update_learns(script, capsys):
    network, other, _ = two_networks()
    optimizer = torch.optim.SGD([*network.parameters(), *other.parameters()])
    line = refused(capsys, script.updater, print, network, optimizer, script.Args(), code=1)
    assert "also steps tensors that its update does not learn" in line


def test_only_bf16_computes_products_in_bfloat16():
    def loss(network, x):
        product = network(x)
        return product.float().sum(), {"product": product}

    for precision, dtype in [("highest", torch.float32), ("bf16", torch.bfloat16)]:
        network, args = nn.Linear(3, 2), sac.Args(compile=False, matmul_precision=precision)
        curves = sac.updater(loss, network, mock.Mock(param_groups=[]), args)(torch.ones(4, 3))
        assert curves["product"].dtype == dtype
        assert network.bias.grad.dtype == torch.float32


@two_scripts
def test_a_gradient_of_any_strides_is_applied_as_it_is(algorithm):
    """The fused Adam of PyTorch 2.13 reads a gradient's memory as if it were the parameter's."""
    signs = torch.tensor([[1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])

    def loss(network):
        return (network.weight.T * signs).sum(), {}

    for by_columns in (False, True):  # as the weights of torch.linalg.qr() are
        script, network = SCRIPTS[algorithm], nn.Linear(3, 2, bias=False)
        if by_columns:
            network.weight.data = torch.randn(3, 2).T
        before = network.weight.detach().clone()
        optimizer = torch.optim.Adam(network.parameters(), lr=0.5, fused=True)
        script.updater(loss, network, optimizer, script.Args(compile=False))()
        # Adam's first step is the learning rate, against the sign of the gradient
        torch.testing.assert_close(network.weight.detach(), before - 0.5 * signs.T)


@two_scripts
def test_a_layer_that_stands_at_two_places_is_learned_as_one(algorithm):
    """As the trunk of an actor and a critic. Its parameters stay the ones that were there."""
    script, trunk = SCRIPTS[algorithm], nn.Linear(3, 4)
    heads = [nn.Sequential(trunk, nn.Linear(4, 1)) for _ in range(2)]
    network, x = nn.ModuleList(heads), torch.randn(5, 3)
    plain = copy.deepcopy(network)

    def loss(network, x):
        return network[0](x).square().mean() + network[1](x).square().mean(), {}

    args = script.Args(compile=False)
    args.max_grad_norm = 1e9
    update = script.updater(loss, network, torch.optim.SGD(network.parameters(), 0.1), args)
    optimizer = torch.optim.SGD(plain.parameters(), 0.1)
    for _ in range(3):
        update(x)
        optimizer.zero_grad()
        loss(plain, x)[0].backward()
        optimizer.step()
    torch.testing.assert_close(network.state_dict(), plain.state_dict())
    assert all(isinstance(p, nn.Parameter) for p in (heads[0][0].weight, heads[1][0].weight))


@two_scripts
def test_a_weight_of_two_layers_is_learned_from_both(algorithm):
    """Also beside an activation that stands at two places."""
    script, act = SCRIPTS[algorithm], nn.Tanh()
    network = nn.Sequential(nn.Linear(3, 3), act, nn.Linear(3, 3), act)
    network[2].weight = network[0].weight
    plain, x = copy.deepcopy(network), torch.randn(5, 3)
    args = script.Args(compile=False)
    args.max_grad_norm = 1e9
    optimizer = torch.optim.SGD(network.parameters(), 0.1)
    script.updater(lambda network, x: (network(x).square().sum(), {}), network, optimizer, args)(x)
    optimizer = torch.optim.SGD(plain.parameters(), 0.1)
    plain(x).square().sum().backward()
    optimizer.step()
    torch.testing.assert_close(network.state_dict(), plain.state_dict())


def test_signals_that_end_the_compiler_wait_until_it_is_done(monkeypatch):
    """Ctrl-C reaches all processes of a terminal: without it, an update would not be compiled."""
    masks = []

    def function():
        masks.append(signal.pthread_sigmask(signal.SIG_BLOCK, []))

    monkeypatch.setattr(torch, "compile", lambda function, **kwargs: function)
    update = sac.compiled(function)
    update()
    update()  # it may be compiled again, for other sizes
    assert masks == [set(sac.STOPPING)] * 2
    assert signal.pthread_sigmask(signal.SIG_BLOCK, []) == set()


# PARTS


def test_ppo_starts_from_orthogonal_weights():
    agent = ppo.Agent(gym.make(ENV)).requires_grad_(False)
    for network, last in ((agent.critic, 1.0), (agent.actor_mean, 0.01)):
        linear = [layer for layer in network if isinstance(layer, nn.Linear)]
        for layer, gain in zip(linear, (2**0.5, 2**0.5, last), strict=True):
            rows, columns = layer.weight.shape
            weight = layer.weight if rows <= columns else layer.weight.T
            identity = torch.eye(len(weight)) * gain**2
            torch.testing.assert_close(weight @ weight.T, identity, rtol=0, atol=1e-5 * gain**2)
            assert not layer.bias.any()
    assert not agent.actor_logstd.any()


def hooked(layer):
    layer.register_forward_hook(lambda module, given, result: 3 * result)
    return layer


@pytest.mark.parametrize(
    ("layers", "translated"),
    [
        ([nn.Linear(3, 4), nn.Tanh(), nn.Linear(4, 4), nn.ReLU(), nn.Linear(4, 2)], True),
        ([nn.Linear(3, 4), nn.GELU(), nn.Linear(4, 2)], False),
        ([nn.Linear(3, 2, bias=False)], True),
        ([nn.utils.parametrizations.spectral_norm(nn.Linear(3, 2))], False),
        ([nn.utils.spectral_norm(nn.Linear(3, 2))], False),  # the old one, by a hook
        ([nn.Linear(3, 2), hooked(nn.Tanh())], False),
    ],
)
def test_a_network_acts_in_numpy_as_in_pytorch(layers, translated):
    network = nn.Sequential(*layers).eval()
    act, forward = ppo.in_numpy(network, "cpu"), mock.Mock(wraps=network.forward)
    with mock.patch.object(network, "forward", forward), torch.no_grad():
        for x in torch.randn(5, 3):
            expected = network(x)
            forward.reset_mock()
            torch.testing.assert_close(torch.from_numpy(act(x.numpy())), expected)
            assert forward.called == (not translated)
            called = ppo.in_numpy(network.__call__, "cpu")  # as a method of an agent would be
            assert called(x.numpy()).tolist() == expected.tolist()
        assert ppo.in_numpy(hooked(network), "cpu")(x.numpy()).tolist() == network(x).tolist()


def test_normalized_numbers_are_clipped():
    """Otherwise they are Gymnasium's: test_ppo_trains_as_a_plain_implementation."""
    assert ppo.Normalizer(0.0, 1.0).normalize(np.array([1e6, -1e6])).tolist() == [10, -10]


def test_a_replay_buffer_stores_each_observation_once():
    env = SimpleNamespace(
        observation_space=gym.spaces.Box(-1, 1, (1000,)), action_space=gym.spaces.Box(-1, 1, (1,))
    )
    state = sac.ReplayBuffer(50, env).__dict__
    assert sum(x.nbytes for x in state.values() if isinstance(x, np.ndarray)) < 50 * 1000 * 4 * 1.1


@pytest.mark.parametrize("script", [sac, td3])
def test_what_is_added_to_a_replay_buffer_is_resumed(script):
    """Such as priorities, one for each step; not what it keeps for a moment."""
    box = gym.spaces.Box(-1, 1, (2,))
    old, new = (
        script.ReplayBuffer(4, SimpleNamespace(observation_space=box, action_space=box))
        for _ in range(2)
    )
    old.priorities, new.priorities, old.drawn = np.ones(4), np.zeros(4), np.arange(3)
    old.add(*np.ones((2, 2)), 1.0, np.ones(2), False, False)
    new.load_state_dict(old.state_dict())
    assert new.priorities.tolist() == [1, 1, 0, 0] and (new.size, new.position) == (2, 1)
    assert new.rewards.tolist() == [1, 0, 0, 0] and new.is_step.tolist() == [True] + 3 * [False]
