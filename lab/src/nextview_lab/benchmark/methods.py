"""Methods that look at frozen episodes: the protocol, nextview itself, and any other process.

A method gets a ``FrozenLook`` for each view and returns a ``MethodAnswer``. Another process gets
the same as one line of JSON on its standard input, and answers with one on its standard output.
"""

import select
import shlex
import subprocess
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import IO, Any, Protocol, cast

import msgspec
import numpy as np

from nextview import __version__
from nextview.checks import did_you_mean, one_line
from nextview.errors import ObservationError, PolicyError, ResultsError, UsageError
from nextview.files import decode_record
from nextview.geometry.axes import upright_axes
from nextview.geometry.viewsphere import Directions, Viewpoints, ViewSphere
from nextview.policies.base import Policy
from nextview.policies.registry import make_policy_anywhere, policy_names
from nextview.recognition.belief import Stopping
from nextview.recognition.model_card import DISCRIMINATE
from nextview.sensing.frame import Frame, check_pose
from nextview.sensing.observed_object import ObservedObject
from nextview.session.limits import Limits
from nextview.session.session import Session
from nextview.session.system import load
from nextview.types import Float, Mask
from nextview_lab.benchmark.frozen import FrozenView, Matrix, as_matrix, read_view
from nextview_lab.benchmark.thing_policies import BLIND_RULES, rules_of

LONGEST_LINE = 1 << 20  # bytes
ANSWER_LIMIT = 600.0  # seconds that a process has for an answer
ENDING = 5.0  # seconds that a process has to end when its input does
ONE_LINE = (
    "standard output is for one line a view, and all else belongs to standard error"
)


WORLD_UP = (0.0, 0.0, 1.0)  # against gravity, in the world of an archive
STRAIGHT_DOWN = 0.99  # cosine, above which a camera looks from above

Row = tuple[float, float, float, float]
PoseRows = tuple[Row, Row, Row, Row]  # nothing longer is read


class FrozenLook(msgspec.Struct, frozen=True):
    """One view of an episode, and what may be looked at next. It holds nothing of the truth.

    Attributes:
        episode: number of the episode.
        step: number of this view in the episode, 1 for the first.
        of: number of views in the episode.
        view: which of the candidate views it is.
        depth: path of the depth image, PNG of 16 bits, 0 for holes.
        mask: path of the mask, PNG: the pixels of the thing are not 0.
        metres_per_unit: of the depth image.
        intrinsics: (3, 3), pixels, the centre of the first pixel at 0.
        poses: reported camera-to-world poses of all candidate views, (V, 4, 4), OpenCV axes,
            metres; z is up in the world. That of this view is ``poses[view]``.
        free: numbers of the views that may come next; empty after the last one.
        held: whether a gripper holds the thing.
        things: names that may be right.
    """

    episode: str
    step: int
    of: int
    view: int
    depth: str
    mask: str
    metres_per_unit: float
    intrinsics: Matrix
    poses: tuple[Matrix, ...]
    free: tuple[int, ...]
    held: bool
    things: tuple[str, ...]


class MethodAnswer(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a method says after a view.

    Attributes:
        name: of the thing; None for unknown.
        confidence: probability that the name is right, 0 to 1.
        confident: whether a robot should act on the name now.
        pose: from the scan of the named thing to the world, (4, 4), metres; None without one.
        next: view to take next, one of ``free``; None after the last one.
    """

    name: str | None
    confidence: float
    confident: bool
    pose: PoseRows | None = None
    next: int | None = None


class Method(Protocol):
    """What can be submitted: it answers one view after the other.

    Attributes:
        name: of the method in tables.
        version: of the method.
        blind: whether its next views ignore the images.
    """

    name: str
    version: str
    blind: bool

    def answer(self, look: FrozenLook) -> MethodAnswer:
        """Answer a view; step 1 begins a new episode.

        Args:
            look: the view.
        """
        ...


class NextviewMethod:
    """nextview with a memory of taught things, and one of its policies.

    Attributes:
        name: nextview and the policy.
        version: of nextview.
        blind: whether the policy ignores the images.
    """

    def __init__(
        self, policy: str, models: str, things: Sequence[str], seed: int
    ) -> None:
        """Open the memory.

        Args:
            policy: geometry, sampled, predicted, random, spread, furthest, fixed or ring, or a
                name of ``load``.
            models: name or folder of the memory.
            things: names that may be right.
            seed: of random policies.

        Raises:
            ModelError: the memory cannot be opened.
            UsageError: the memory knows none of the things.
            PolicyError: there is no such policy.
        """
        self.name = f"nextview {policy}"
        self.version = __version__
        self.blind = policy in BLIND_RULES
        self._policy = policy
        self._seed = seed

        self._things = frozenset(things)
        self._system = load(
            models, policy="random-all", stopping=never, max_views=1000, threads=1
        )
        if not self._things & set(self._system.classes):
            raise UsageError(f"{models}: knows none of the things of the archive")

        self._rule = Stopping.of(self._system.models.recogniser.calibration)
        self._sphere = ViewSphere.named("40")
        self._make_policy(self._sphere)
        self._session: Session | None = None
        self._rng = np.random.default_rng(seed)

    def answer(self, look: FrozenLook) -> MethodAnswer:
        """Answer a view; see ``Method``."""
        if look.step == 1:
            self._session = self._begun(look)
        session = self._session
        assert session is not None  # the first look of an episode has step 1

        free = np.zeros(len(look.poses), bool)
        free[list(look.free)] = True
        if free.any():
            session.reachable = free
        images = FrozenView(Path(look.depth), Path(look.mask))
        depth, mask = read_view(images, look.metres_per_unit)
        pose = np.array(look.poses[look.view])
        # where it shows too little of the thing, the answer stays what it was
        with suppress(ObservationError):
            session.update(Frame(depth, np.array(look.intrinsics), pose, mask=mask))
        return self._said(session, free)

    def _begun(self, look: FrozenLook) -> Session:
        """Return the session of a new episode, whose candidates are those of the episode."""
        self._rng = np.random.default_rng((self._seed, int(look.episode)))
        poses = np.array(look.poses)
        first = poses[look.view]
        away = poses[:, :3, 3] - aimed_at(poses)

        # an object frame points towards the first camera
        above = abs(first[2, 2]) >= STRAIGHT_DOWN
        axes = upright_axes(WORLD_UP, first[:3, 1] if above else -first[:3, 2])
        sphere = Directions(away @ axes.T)
        system = replace(self._system, policy=self._make_policy(sphere), sphere=sphere)
        session = system.session(
            start=look.view,
            seed=int(self._rng.integers(2**62)),
            object=ObservedObject(WORLD_UP, support=not look.held),
            distance=float(np.median(np.linalg.norm(away, axis=1))),
        )
        session.limits = Limits.none()
        return session

    def _make_policy(self, sphere: Viewpoints) -> Policy:
        known = rules_of(sphere, self._sphere)
        if self._policy in known:
            return known[self._policy]()
        plain = self._policy.partition("@")[0]
        others = (*policy_names(), DISCRIMINATE)
        if plain not in others and ":" not in plain and not plain.endswith(".json"):
            raise PolicyError(
                f"no policy is called {self._policy!r}; there are {', '.join(known)}, and"
                " MODULE:CLASS for your own"
            )
        return make_policy_anywhere(
            self._policy, sphere, (), self._system.models.classes
        )

    def _said(self, session: Session, free: Mask) -> MethodAnswer:
        """Return the answer of a session."""
        chosen = None
        if free.any():
            ready = bool(session.views) and not session.done and free[session.view]
            chosen = (
                session.view if ready else int(self._rng.choice(np.flatnonzero(free)))
            )
        if not session.views:
            return MethodAnswer(None, 0.0, False, next=chosen)

        result = session.result
        name = result.answer if result.answer in self._things else None
        if name is None:
            return MethodAnswer(None, 0.0, False, next=chosen)
        reached = self._rule.reached(np.array([result.confidence]), len(session.views))
        pose = result.pose
        return MethodAnswer(
            name,
            result.confidence,
            bool(reached) and not result.joint_doubt,
            None if pose is None else cast(PoseRows, as_matrix(pose)),
            chosen,
        )


def aimed_at(poses: Float) -> Float:
    """Return the point that cameras are aimed at: the nearest to all of their optical axes.

    Args:
        poses: camera-to-world, (V, 4, 4), OpenCV axes, metres.

    Returns:
        The point, (3,), metres; half a metre ahead of cameras that look in one direction.
    """
    places = poses[:, :3, 3]
    ahead = poses[:, :3, 2]
    across = np.eye(3) - ahead[:, :, None] * ahead[:, None, :]
    total = across.sum(0)
    if np.linalg.cond(total) > 1e6:
        return np.asarray((places + 0.5 * ahead).mean(0))
    return np.linalg.solve(total, (across @ places[:, :, None]).sum(0)[:, 0])


def never(believed: Any, threshold: float) -> Mask:
    """Stop never: an episode has as many views as were asked for."""
    return np.zeros(np.shape(believed.highest), bool)


class CommandMethod:
    """A method in another process.

    It reads a line of JSON on its standard input for each view, and answers with one on its
    standard output. What it writes to standard error is shown.

    Attributes:
        name: of the method in tables.
        version: of the method.
        blind: whether its next views ignore the images.
    """

    def __init__(
        self, command: str, name: str, version: str, blind: bool = False
    ) -> None:
        """Start the process.

        Args:
            command: as in a shell, such as "python my_method.py".
            name: of the method in tables.
            version: of the method.
            blind: whether its next views ignore the images.

        Raises:
            UsageError: the command cannot be started.
        """
        self.name = name
        self.version = version
        self.blind = blind
        self._command = one_line(command)
        pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        try:
            self._process = subprocess.Popen(shlex.split(command), bufsize=0, **pipes)
        except (OSError, ValueError, IndexError) as error:
            raise UsageError(f"{self._command}: cannot be started ({error})") from None

    def answer(self, look: FrozenLook) -> MethodAnswer:
        """Answer a view; see ``Method``.

        Args:
            look: the view.

        Raises:
            ResultsError: the process had written something before, has ended, takes longer than
                ``ANSWER_LIMIT``, or what it says is no answer.
        """
        where = f"{self._command}, episode {look.episode}, view {look.step}"
        output = cast(IO[bytes], self._process.stdout)
        if select.select([output], [], [], 0)[0]:
            self._refuse_unasked(output.readline(LONGEST_LINE))
        with suppress(BrokenPipeError):  # then its output has ended, too
            line = msgspec.json.encode(look) + b"\n"
            cast(IO[bytes], self._process.stdin).write(line)
        said = self._line(where)
        if not said:
            raise ResultsError(f"{where}: the process has ended, or closed its output")
        return decode_record(
            said,
            MethodAnswer,
            f"{where}: {_quoted(said)} is not an answer, a line of JSON with name, confidence and"
            " confident",
            ResultsError,
        )

    def _line(self, where: str) -> bytes:
        """The next line of the output; ResultsError if it is not there in time."""
        output = cast(IO[bytes], self._process.stdout)
        until = time.monotonic() + ANSWER_LIMIT
        line = b""
        while not line.endswith(b"\n") and len(line) < LONGEST_LINE:
            left = max(until - time.monotonic(), 0)
            if not select.select([output], [], [], left)[0]:
                raise ResultsError(
                    f"{where}: {self.name} has not answered within {ANSWER_LIMIT:g} s"
                )
            letter = output.read(1)
            if not letter:
                break
            line += letter
        return line

    def finish(self) -> None:
        """See that it has said nothing but its answers, and end it; ResultsError if it has."""
        self._refuse_unasked(self.close())

    def close(self) -> bytes:
        """End the input of the process, and after 5 s the process; what it wrote unasked."""
        if self._process.returncode is not None:
            return b""
        with self._process:
            try:
                return self._process.communicate(timeout=ENDING)[0]
            except subprocess.TimeoutExpired as late:
                self._process.kill()  # what it has started may keep the output open
                return late.output or b""

    def _refuse_unasked(self, said: bytes) -> None:
        if said:
            raise ResultsError(
                f"{self._command}: {_quoted(said)} was written unasked: {ONE_LINE}"
            )


def _quoted(said: bytes) -> str:
    """The first line of an output, as a sentence quotes it."""
    first = said.partition(b"\n")[0].decode("utf-8", "backslashreplace")
    return f"'{one_line(first)}'"


def check_answer(answer: MethodAnswer, look: FrozenLook, where: str) -> None:
    """Check what a method said.

    Args:
        answer: what it said.
        look: of what.
        where: beginning of the sentence of an error.

    Raises:
        ResultsError: the name is not known, the confidence is no probability, the pose is none, or
            the next view may not be taken.
    """
    check_said(answer.name, answer.confidence, answer.pose, look.things, where)
    if look.free and answer.next not in look.free:
        raise ResultsError(f"{where}: the next view is one of free, not {answer.next}")


def check_said(
    name: str | None,
    confidence: float,
    pose: PoseRows | None,
    things: Sequence[str],
    where: str,
) -> None:
    """Check a name, its probability, and a pose; see ``check_answer``.

    Args:
        name: the name; None for unknown.
        confidence: its probability.
        pose: (4, 4), metres; None without one.
        things: names that may be right.
        where: beginning of the sentence of an error.

    Raises:
        ResultsError: one of them is none.
    """
    if name is not None and name not in things:
        near = did_you_mean(name, things)
        raise ResultsError(
            f"{where}: the archive has no thing called {one_line(repr(name))}{near}"
        )

    if not 0 <= confidence <= 1:
        raise ResultsError(
            f"{where}: a confidence is between 0 and 1, not {confidence}"
        )
    if pose is None:
        return
    try:
        check_pose(pose)
    except ObservationError as error:
        raise ResultsError(f"{where}: {error}") from None
