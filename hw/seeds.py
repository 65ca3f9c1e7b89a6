"""How a seed is split: a stream of random numbers for each purpose, so that none depends on how much another draws.

A stream is numpy's `SeedSequence` of the seed and the numbers that follow it. numpy fills up with zeros, so that
`[seed]`, `[seed, 0]` and `[seed, 0, 0]` are one stream. All numbers here are what recorded runs are repeated by.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np


class Stream(IntEnum):
    """What a stream of a run's seed is for."""

    BODY = 0  # the robot that is drawn, and the noise of its sensors; followed by 1: while a rig holds the robot
    TASK = 1  # the episode that the task draws
    TEAMMATES = 2  # followed by a robot's number from 1 on: its body, as BODY is the first one's
    FAULTS = 7  # of a virtual rig
    DELIVERY = 11  # of a virtual rig's servos: how they were put together
    EVALUATION = 20_250_417  # follows an episode's number; see `evaluation_seed`


def generator(seed: int, *numbers: int) -> np.random.Generator:
    """The generator of a stream. In a fleet of worlds the numbers are world and episode, after a tag where there is
    one: the first world's first episode is drawn like a run's BODY, and its second like BODY, 1."""
    return np.random.default_rng([seed, *numbers])


def episode_seed(seed: int, episode: int) -> int:
    """The seed that repeats episode `episode` of a rollout with `servoid run`."""
    return _derived(seed, episode)


def evaluation_seed(seed: int, episode: int) -> int:
    """The same for an evaluation, whose episodes are not those of a rollout, on which settings are tried."""
    return _derived(seed, episode, Stream.EVALUATION)


def teammate_seed(seed: int, number: int) -> int:
    """The seed of the policy of a scene's other robot, by its number from 1 on. It happens to be that of the rollout's
    episode of the same number."""
    return _derived(seed, number)


def wide_seed(*numbers: int) -> int:
    """A seed of 63 bits for each sequence of numbers, none of them negative: for generators of torch."""
    return int(np.random.SeedSequence(numbers).generate_state(1, np.uint64)[0] >> np.uint64(1))


def _derived(*numbers: int) -> int:
    return int(np.random.SeedSequence(numbers).generate_state(1)[0])
