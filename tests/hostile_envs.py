"""Somebody else's environment, `hostile_envs:Hostile-v0`: right by the API, and all unusual.

It has worker processes, makes a new action space at every access and asserts that actions are in
it, ends episodes with arrays, draws global random numbers and has no others, writes into the
actions it gets, returns the same info at every step, declares no time limit and writes a file when
it is closed: HOSTILE_LOG names it.
"""

import multiprocessing
import os
import random

import gymnasium as gym
import numpy as np
import torch
from gymnasium.spaces import Box

LOW, HIGH = -0.2, 1.3  # tanh(x) * 0.75 + 0.55 rounds to a number below LOW


def log(line):
    with open(os.environ.get("HOSTILE_LOG", os.devnull), "a") as file:
        file.write(f"{line}\n")


def work(connection):
    """Return every number plus 1, until there are no more."""
    while True:
        try:
            connection.send(connection.recv() + 1)
        except EOFError:
            return


class Hostile(gym.Env):
    observation_space = Box(-np.inf, np.inf, (2,), np.float64)
    info = {}

    def __init__(self, workers=2, dtype=np.float32, length=8):
        self.dtype, self.length = dtype, length
        self.np_random = random  # which has no state_dict, nor a bit_generator
        self.offset = random.random() + np.random.random() + torch.rand(()).item()
        fork = multiprocessing.get_context("fork")
        self.connections, self.processes = [], []
        for _ in range(workers):
            ours, theirs = fork.Pipe()
            process = fork.Process(target=work, args=(theirs,), daemon=True)
            process.start()
            theirs.close()
            self.connections.append(ours)
            self.processes.append(process)
            log(f"worker {process.pid}")

    @property
    def action_space(self):
        return Box(LOW, HIGH, (1,), self.dtype)

    def ask(self, number):
        for connection in self.connections:
            connection.send(number)
        assert {connection.recv() for connection in self.connections} <= {number + 1}

    def reset(self, *, seed=None, options=None):
        self.steps = 0
        numbers = self.np_random.random(), np.random.random() + torch.rand(()).item()
        return np.array(numbers) + self.offset, self.info

    def step(self, action):
        assert self.action_space.contains(action), f"{action!r} is not in {self.action_space}"
        self.steps += 1
        self.ask(self.steps)
        observation = np.array([random.gauss(0, 1), np.random.normal()])
        reward = np.array([float(action[0]) * observation[0]])
        action[:] = HIGH  # it is its own array, the environment thinks
        terminated, truncated = np.array([self.steps == self.length]), np.bool_(False)
        return observation, reward, terminated, truncated, self.info

    def close(self):
        for process in self.processes:
            process.terminate()
            process.join()
        log(f"closed {os.getpid()}")


class Broken(Hostile):
    """Its step fails."""

    def step(self, action):
        if self.steps == 3:
            raise KeyError("broken")
        return super().step(action)


def register(entry_point, name="", **kwargs):
    gym.register(f"{name or entry_point.__name__}-v0", entry_point, kwargs=kwargs)


register(Hostile)
register(Broken)
register(Hostile, "HostileAlone", workers=0)
register(Hostile, "HostileHalf", workers=0, dtype=np.float16)
