"""Takes toward random places: where they lead by kinematics, and which are kept."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from servoid.hw.config import ConfigError
from servoid.hw.robot.description import load_robot
from servoid.policy.diffusion.prefix.frames import Frames
from servoid.policy.features import raw_layout
from servoid.policy.motion.library import Library
from servoid.policy.text.encoder import load_encoder
from servoid.tools.learn.planner_settings import PlannerTraining
from servoid.tools.learn.takes.aimed import Aim, AimedMotion, AimedRecipe, AimedTake, Move, load_aimed, moved
from servoid.tools.learn.takes.executed import Executed
from servoid.tools.learn.takes.learned import came_to, learned_from
from servoid.tools.learn.takes.maker import TakeMaker, labels
from servoid.tools.motions.keyframes import AuthoredClip, Keyframe

ROBOT = load_robot()
FRAMES, RECIPE = Frames(ROBOT), load_aimed("aimed")
CLIPS = [Library(ROBOT)[name] for name in ("punch-right", "sit-down", "rise")]


def _takes(recipe: AimedRecipe, count: int) -> list[AimedTake]:
    maker = TakeMaker(ROBOT, CLIPS, np.random.default_rng(0), recipe.captions)
    return Aim(ROBOT, recipe, maker, FRAMES).takes(count, np.random.default_rng(1))


def _executed(aimed: AimedTake, number: int, ticks: int | None = None, off: float = 0.0) -> Executed:
    """As a robot does that follows it to the point, but for so many metres of the base."""
    take = aimed.take
    layout = raw_layout(len(ROBOT.joints))
    raw = np.zeros((take.ticks, layout.size))
    motion = FRAMES.motion(take.place, take.orientation, take.joints)
    parts = {name: raw[:, layout.slice(name)] for name in ("gravity", "yaw", "displacement", "position")}
    w, x, y, z = take.orientation.T
    parts["gravity"][:] = np.stack([2 * (w * y - x * z), -2 * (w * x + y * z), 2 * (x * x + y * y) - 1], -1)
    parts["yaw"][:, 0] = motion.heading
    late = (np.arange(take.ticks) > aimed.begun)[:, None]
    parts["displacement"][:], parts["position"][:] = take.place + late * [off, 0.0, 0.0], take.joints
    cut = slice(None, ticks)
    return Executed(raw[cut], replace(take, **{k: v[cut] for k, v in vars(take).items()}), number)


def test_parts_come_to_other_places_each_time_by_kinematics_from_standing_to_standing() -> None:
    takes = _takes(RECIPE, 2 * len(RECIPE.motions))
    assert {each.part for each in takes} == {"right hand", "right foot", "pelvis"}
    names = list(labels(CLIPS, RECIPE.captions))
    assert names[-5:] == ["reach-right-hand", "kick-high-right", "step-right", "sit-on-seat", "rise-from-seat"]
    for one, other in zip(takes, takes[len(RECIPE.motions) :], strict=False):
        assert one.name == other.name
        motions = [FRAMES.motion(t.take.place, t.take.orientation, t.take.joints) for t in (one, other)]
        places = [
            motion.place if each.part == "pelvis" else motion.points[:, FRAMES.key_points.names.index(each.part)]
            for each, motion in zip((one, other), motions, strict=True)
        ]
        assert np.linalg.norm(places[0][one.tick] - places[1][other.tick]) > 0.004
        assert np.linalg.norm(places[0][one.tick] - places[0][0]) > 0.01, "it goes somewhere"
        assert one.take.label[one.tick] == names.index(one.name)
        np.testing.assert_allclose(one.take.joints[[0, -1]], np.tile(ROBOT.home, (2, 1)), atol=1e-6)
        assert (motions[0].contact.max(-1) > 0.0).all(), "a foot is on the ground"


def test_what_falls_or_misses_its_place_is_not_kept(capsys: pytest.CaptureFixture[str]) -> None:
    aimed = _takes(RECIPE, 2)
    done = [_executed(aimed[0], 0), _executed(aimed[1], 1, ticks=aimed[1].take.ticks - 1)]
    assert [each.number for each in came_to(aimed, done, FRAMES)] == [0]
    assert "1 of 1 reach-right-hand, 0 of 1 punch-right" in capsys.readouterr().err
    assert not came_to(aimed, [_executed(aimed[0], 0, off=0.05)], FRAMES)


@pytest.mark.slow
def test_robots_execute_takes_toward_random_places_and_the_planner_learns_from_both(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "one.yaml"
    path.write_text(
        "licence: CC0-1.0\nmotions:\n  - part: right hand\n    at: 1\n    low: [0, 0, 0]\n    high: [0.02, 0.02, 0]\n"
        "    moves: [{frame: 1, part: r_hand}]\n    clips:\n      - name: point\n        captions: [point there]\n"
        "        frames:\n          - {seconds: 0.5, reach: {r_hand: [0.08, -0.14, 0.06]}, hold: 0.4}\n"
        "          - {seconds: 0.5, home: true}\n"
    )
    settings = PlannerTraining(
        clips=("wave",), clip_takes=1, walk_takes=3, walk_seconds=2.0, prefix=4, frames=6,
        aimed=str(path), aimed_takes=2,
    )  # fmt: skip
    encoder = load_encoder("words")
    windows, source, licence = learned_from(ROBOT, FRAMES, encoder, settings, None, "tracker")
    assert "2 of 2 takes toward random places" in source
    assert licence.endswith("CC0-1.0")
    assert "2 of 2 point" in capsys.readouterr().err
    assert "point there" in windows.sentences.texts
    with pytest.raises(ConfigError, match="--aimed: a tracker says"):
        learned_from(ROBOT, FRAMES, encoder, settings)


def test_a_recipe_that_leads_nowhere_says_so() -> None:
    clip = AuthoredClip("point", ("point",), (Keyframe(0.5, reach={"r_hand": (0.1, -0.1, 0.1)}),))
    motion = AimedMotion("right hand", 1, (0.3, 0.0, 0.0), (0.4, 0.0, 0.0), (Move(1, "r_hand"),), (clip,))
    with pytest.raises(ConfigError, match=r"none of 20 places is within reach: .* out of reach"):
        _takes(AimedRecipe("CC0-1.0", (motion,)), 1)
    with pytest.raises(ConfigError, match="part: unknown 'tail'"):
        _takes(AimedRecipe("CC0-1.0", (replace(motion, part="tail"),)), 1)
    with pytest.raises(ConfigError, match="keyframe 1 does not say where 'l_hand' is"):
        moved(replace(motion, moves=(Move(1, "l_hand"),)), np.zeros(3), ["left", "right"])
    with pytest.raises(ValueError, match="1 to 1"):
        replace(motion, at=2)
    with pytest.raises(ValueError, match="low must not be above high"):
        replace(motion, low=(0.5, 0.0, 0.0))
