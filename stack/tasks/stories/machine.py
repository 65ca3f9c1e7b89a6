"""The state machine of a story: it goes to the thing of the act, asks for the act, sees by the estimate and by what is
seen of the thing whether it is done, tries again where it is not, and gives up when the act's time is over.

It asks for skills by name or, of a policy that is told in words, by a sentence and targets.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.world import Percept
from servoid.hw.geometry import to_heading, turned, yaw_of
from servoid.stack.navigation.go_to_point import SpeedProfile
from servoid.stack.navigation.go_to_pose import NEAR, go_to_pose
from servoid.stack.skills.skill import Skill
from servoid.stack.tasks.base import BaseBehaviour
from servoid.stack.tasks.stories.act import PELVIS, Act
from servoid.stack.tasks.stories.condition import REST_SECONDS, Conditions, Moment, held_ticks, rests
from servoid.stack.tasks.stories.standstill import Standstill, farther
from servoid.stack.tasks.stories.told import StoryEpisode, StorySettings

AGAIN_SECONDS = 2.0  # after a skill that did not do it, before another try
READY_SECONDS = 0.8  # in which a planner comes to a stand before what it is told, and may be told otherwise
STAGE = 0.04  # m from there that will do
STRAYED = 0.8  # of how far from there an act that is done by standing there may be
FAR = 0.25  # m from there beyond which a robot that had come near walks there anew: turning, it drifts
AWAY = 0.08  # m farther off that a robot turns its back to a seat: its toes need room
ROUND = 0.7  # of how far a robot is beside a seat
REST_AT_END = 1.0  # s, of standing or sitting
# m of the base before a seat's front edge as a story ends: lowered nearer to it, its back meets the seat and it tips.
CLEAR_OF_SEAT = 0.16
LEAVE_SECONDS = 8.0  # at most, to get there
PROFILE = SpeedProfile(reverse=0.1, lateral=0.1)


class Machine(BaseBehaviour):
    """The state machine of one story."""

    def __init__(
        self,
        episode: StoryEpisode,
        settings: StorySettings,
        conditions: Conditions,
        skills: Mapping[str, Skill],
        dt: float,
    ) -> None:
        super().__init__(episode)
        self._settings, self._conditions, self._skills, self._dt = settings, conditions, skills, dt
        self._performs = settings.by == "skills"
        self._number = self._began = 0
        self._acting: int | None = None  # tick at which the act itself was asked for
        self._facing: float | None = None  # rad, toward the thing, as its approach began
        self._stop = Standstill(dt)
        self._near = False  # whether it has come near to where the act is performed
        self._aside = False  # whether it has turned its back to the seat, away from it
        self._done = False  # the act, though the robot may be in the middle of it
        self._held = 0  # ticks for which what it is done by has held
        self._recent: deque[State] = deque(maxlen=self._ticks(REST_SECONDS) + 1)
        self._events: list[str] = []
        self._lost: str | None = None
        self._over: int | None = None  # tick at which the story ended, done or given up
        self._rests: int | None = None  # and from which on it rests then
        self._tick = 0

    def take_events(self) -> tuple[str, ...]:
        taken, self._events = tuple(self._events), []
        return taken

    def done(self, state: State) -> bool:
        return self._rests is not None and self._tick - self._rests >= self._ticks(REST_AT_END)

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        self._tick = tick
        self._recent.append(state)
        if self._over is not None:
            return self._end(tick - self._over, state, percept)
        thing, lost = self._see(percept)
        self._say(lost)
        act = self._act
        if self._done or (lost is None and self._is_done(act, state, thing)):
            if not self._done:
                self._events.append(f"'{act.name}' is done, {(tick - self._began) * self._dt:.1f} s after it began")
            self._done = True
            if self._in_motion(act):
                return Instruction(np.zeros(3), text=act.sentence)
            self._next(tick)
            return self._rest() if self._over is not None else self.instruct_again(state, percept)
        if (tick - self._began) * self._dt > act.seconds:
            self._events.append(f"'{act.name}' is given up: not done within {act.seconds:g} s")
            self._over = tick
            return self._rest()
        return self._rest() if lost is not None else self._ask(act, state, thing)

    def instruct_again(self, state: State, percept: Percept) -> Instruction:
        """For the act that has just begun."""
        thing, lost = self._see(percept)
        self._say(lost)
        return self._rest() if lost is not None else self._ask(self._act, state, thing)

    @property
    def _act(self) -> Act:
        act: Act = self.episode.acts[self._number]
        return act

    def _next(self, tick: int) -> None:
        self._come_anew()
        self._near = self._aside = self._done = False
        self._held, self._began = 0, tick
        if self._number + 1 == len(self.episode.acts):
            self._over = tick
        else:
            self._number += 1

    def _rest(self) -> Instruction:
        """Stand; a robot that sits stays seated until it is asked to rise."""
        seated = self._acting is not None or (self._over is not None and self._act.done.seated)
        skill = self._act.skill if seated and self._performs else None
        text = self._act.sentence if seated and not self._performs else None
        return Instruction(np.zeros(3), skill=skill, text=text, stand=skill is None and text is None)

    def _end(self, since: int, state: State, percept: Percept) -> Instruction:
        """Step away from a seat, `since` so many ticks, and rest."""
        if self._rests is None:
            away = self._away(state, percept) if since < self._ticks(LEAVE_SECONDS) else None
            if away is not None:
                return Instruction(go_to_pose(away, 0.0, PROFILE, STAGE, NEAR), goal=away)
            self._rests = self._tick
        return self._rest()

    def _away(self, state: State, percept: Percept) -> Array | None:
        """Where to stand `(2,)` m, in the heading frame, for a robot just before a seat; None: it is not."""
        number = next((i for i, thing in enumerate(self.episode.objects) if thing.kind == "seat"), None)
        if number is None or percept.objects is None or self._act.done.seated:
            return None
        seat, (depth, width, _) = percept.objects[number], self.episode.objects[number].size
        facing = float(yaw_of(seat[3:]))
        x, y = turned(state.displacement[:2] - seat[:2], -facing)
        before = x - depth / 2  # NaN where it is not seen
        if not (-depth / 2 <= before < CLEAR_OF_SEAT and abs(y) < width / 2 + CLEAR_OF_SEAT):
            return None
        place = seat[:2] + turned(np.array([depth / 2 + CLEAR_OF_SEAT + STAGE, y]), facing)
        return to_heading(place[None], state)[0]

    # -- what is seen --------------------------------------------------------------------------------------------------

    def _see(self, percept: Percept) -> tuple[Array, str | None]:
        """The thing's pose `(7,)` in the odometry frame, and why it is not gone by."""
        index = self.episode.things[self._number]
        if index < 0:
            mark = percept.goal if percept.age <= self._settings.stale else None
            return self.episode.point(self._number, percept.objects, mark), None
        kind, nothing = self.episode.objects[index].kind, np.full(7, np.nan)
        if percept.objects is None or len(percept.objects) <= index or not np.isfinite(percept.objects[index]).all():
            return nothing, f"the {kind} is not seen any more"
        if percept.age > self._settings.stale:
            return nothing, f"what is seen of the {kind} is {percept.age:.1f} s old"
        return percept.objects[index], None

    def _say(self, lost: str | None) -> None:
        what = None if lost is None else lost.split(" is ")[0]
        if what != self._lost:
            self._events.append(f"{lost}: the robot stands and waits" if lost else "it is seen again")
        self._lost = what

    def _is_done(self, act: Act, state: State, thing: Array) -> bool:
        before, legs = self._recent[0], self._conditions.legs
        still = rests(state.position[legs], before.position[legs], state.orientation, before.orientation)
        now = Moment(state.displacement, state.orientation, state.position, still)
        held = self._conditions.hold(act, now, thing, self.episode.seat(self._number))
        self._held = self._held + 1 if bool(held) else 0
        return self._held >= held_ticks(act, self._dt)

    # -- what is asked -------------------------------------------------------------------------------------------------

    def _ask(self, act: Act, state: State, thing: Array) -> Instruction:
        if self._acting is not None and self._strayed(act, state, thing):
            self._events.append(f"'{act.name}': it came to a stand beside the place, and walks there again")
            self._come_anew()
        if self._acting is not None and self._too_late(act):
            self._events.append(f"'{act.name}' is tried again")
            self._come_anew()
        if self._acting is None:
            come = None if act.approach is None else self._come(act, state, thing)
            if come is not None:
                return come
            self._acting = self._tick
        if self._performs:
            return Instruction(np.zeros(3), skill=act.skill, stand=act.skill is None)
        return self._told(act, state, thing)

    def _too_late(self, act: Act) -> bool:
        """Whether the act was performed, and did not do it: what stays where it is, as on a seat, is given its time."""
        if self._acting is None or act.approach is None or act.skill is None or act.done.seated:
            return False
        return self._tick - self._acting > self._ticks(self._lasts(act, act.skill) + AGAIN_SECONDS)

    def _strayed(self, act: Act, state: State, thing: Array) -> bool:
        """Whether an act that is done by standing somewhere is not, since the robot went on a little as it stopped."""
        if self._acting is None or act.approach is None or act.done.part != PELVIS:
            return False
        away = float(np.linalg.norm(self._place(act, state, thing)[0]))
        return self._tick - self._acting > self._ticks(READY_SECONDS) and away > STRAYED * act.done.within

    def _lasts(self, act: Act, skill: str) -> float:
        """s that an act takes by its skill, or by a planner."""
        return act.lasts if act.lasts and not self._performs else self._skills[skill].seconds

    def _in_motion(self, act: Act) -> bool:
        """Whether a planner is in the middle of what it was told: it knows no way back from there, on one foot say, but
        to its end. Before that, a kick at a bag that it has walked over would end on it. A skill ends by itself."""
        if self._performs or self._acting is None or act.skill is None:
            return False
        since = self._tick - self._acting
        return self._ticks(READY_SECONDS) <= since < self._ticks(self._lasts(act, act.skill))

    def _come_anew(self) -> None:
        self._acting = self._facing = None
        self._stop = Standstill(self._dt)

    def _come(self, act: Act, state: State, thing: Array) -> Instruction | None:
        """To where the act is performed and, where a planner strikes, to a stand there; None where the robot is."""
        if act.limb is None or self._performs:
            return self._walk(act, state, thing)
        walk = None if self._stop.stands(self._tick) else self._walk(act, state, thing)
        if walk is not None:
            self._stop.step(walk.velocity[:2])
            return walk
        if self._stop.stands(self._tick) or not self._stop.stand(self._tick):
            return self._rest()
        return None

    def _walk(self, act: Act, state: State, thing: Array) -> Instruction | None:
        """To where the act is performed; None where the robot is there."""
        assert act.approach is not None
        to = act.approach
        ahead, turn = self._place(act, state, thing)
        away, slack = float(np.linalg.norm(self._stop.left(ahead))), self._stop.slack
        if to.back and self._aside:  # straight back, however far aside: heels feel their way to a seat
            away, ahead = max(-float(ahead[0]), 0.0), np.array([ahead[0], 0.0])
        if to.back and not self._aside:
            self._aside = away <= STAGE and abs(turn) <= to.turned
            away = math.inf
        there = away <= slack * to.within and abs(turn) <= slack * to.turned
        if there:
            return None
        faces = to.turned < math.pi
        near = FAR if self._near else NEAR
        velocity = go_to_pose(ahead, turn if faces else 0.0, PROFILE, to.within, near)
        self._near = float(np.linalg.norm(ahead)) <= near
        if faces and self._near:
            # First it turns, then it steps: a planner that is told to turn and shown a place beside it stumbles.
            place = ahead if velocity[:2].any() else np.zeros(2)
            return Instruction(velocity, targets={"ground": place, "heading": np.array(turn)})
        return Instruction(velocity, goal=ahead)

    def _place(self, act: Act, state: State, thing: Array) -> tuple[Array, float]:
        """Where the base shall be before the act `(2,)` m, in the heading frame, and the turn to how it shall face."""
        to, seat = act.approach, self.episode.seat(self._number)
        assert to is not None
        if to.back:
            facing = float(yaw_of(thing[3:]))
            edge = to.ahead + (0.0 if seat is None else seat.size[0] / 2) + (0.0 if self._aside else AWAY)
            if not self._near:  # round the corners: from beside a seat, so much farther before it
                edge += ROUND * abs(float(turned(state.displacement - thing[:3], -facing)[1]))
            place = thing[:2] + turned(np.array([edge, to.aside]), facing)
        else:
            if act.done.faces is not None:
                self._facing = float(yaw_of(thing[3:]))
            if self._facing is None:  # kept from then on: seen from near by, where it should face turns with each step
                away = thing[:2] - state.displacement[:2]
                self._facing = math.atan2(away[1], away[0])
            facing = self._facing
            place = thing[:2] - turned(np.array([to.ahead, to.aside]), facing)
        turn = (facing - float(state.yaw) + math.pi) % (2 * math.pi) - math.pi
        if act.limb is not None and self._near:
            aside = float(turned(place - state.displacement[:2], -facing)[1])
            place = place - turned(np.array([farther(aside, turn), 0.0]), facing)
        return to_heading(place[None], state)[0], turn

    def _told(self, act: Act, state: State, thing: Array) -> Instruction:
        """A sentence, and where parts of the body shall be at the end of a plan."""
        facing = float(yaw_of(thing[3:])) if self.episode.things[self._number] >= 0 else float(state.yaw)
        targets = {}
        for part, offset in act.targets.items():
            place = thing[:3] + turned(np.array(offset), facing)
            flat = to_heading(place[None, :2], state)[0]
            targets[part] = flat if part == "ground" else np.append(flat, place[2])
        return Instruction(np.zeros(3), text=act.sentence or "stand still", targets=targets or None)

    def _ticks(self, seconds: float) -> int:
        return max(round(seconds / self._dt), 1)
