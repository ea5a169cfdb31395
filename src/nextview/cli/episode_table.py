"""Print an episode as a table."""

from collections.abc import Sequence

import numpy as np
from rich import box
from rich.console import JustifyMethod
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from nextview.cli.exit_status import printable
from nextview.cli.progress import Terminal
from nextview.session.result import Recognition

UNLIMITED = 10_000  # columns of a terminal
SHOWN_POSES = 5  # beside the likeliest
SPARE_COLUMNS = (
    "stops at",
    "travel",
    "next",
)  # in the order in which they are left out


def _angles(view: int, angles: tuple[float, float]) -> str:
    return f"{view}\n{angles[0]:.0f}°, {round(angles[1]) % 360}°"


def print_episode(
    result: Recognition,
    name: str,
    policy: str,
    frames: Sequence[str] = (),
) -> None:
    """Print each view and the answer.

    Args:
        result: of the episode.
        name: of the object.
        policy: name of the policy.
        frames: name of the captured frame used for each view; empty for rendered views.
    """
    stops = [
        float(result.stopping.threshold_at(step))
        for step in range(1, len(result.views) + 1)
    ]
    # custom stopping rules may have no threshold
    has_threshold = bool(np.isfinite(stops).any())

    console = Terminal()
    columns = ["step", "view", "this view alone", "belief, top 3", "next", "travel"]
    if has_threshold:
        columns.insert(4, "stops at")
    table = _table_of_views(result, name, policy, frames, stops, columns)
    for spare in SPARE_COLUMNS:
        unlimited = console.options.update_width(UNLIMITED)
        if Measurement.get(console, unlimited, table).maximum <= console.width:
            break
        columns = [column for column in columns if column != spare]
        table = _table_of_views(result, name, policy, frames, stops, columns)
    console.print(table)
    for step, view in enumerate(result.views, 1):
        for warning in view.warnings:
            console.print(f"Step {step}: warning ({warning.name}): {warning.message}.")

    console.print(_answer_in_words(result, has_threshold))
    named = result.unknown or result.pose_candidates
    if result.novelty is not None and not named:
        console.print(
            f"Known or unknown: {100 * result.novelty:.3g} % of known objects fit as badly as this"
            f" one or worse; {_limit_in_words(result.unknown_rate)}."
        )
    for line in _pose_in_words(result):
        console.print(line, soft_wrap=True)


def _limit_in_words(unknown_rate: float) -> str:
    """Describe the p-value below which an object is called unknown."""
    if not unknown_rate:
        return "none is called unknown, as asked for"
    return f"below {100 * unknown_rate:.3g} % it would be called unknown"


def _table_of_views(
    result: Recognition,
    name: str,
    policy: str,
    frames: Sequence[str],
    stops: Sequence[float],
    columns: Sequence[str],
) -> Table:
    """Make a table with a row for each view; ``stops`` holds the threshold of each."""
    table = Table(box=box.SIMPLE, show_lines=True, pad_edge=False, padding=(0, 1, 0, 0))
    table.title = f"Looking at {name}, next views by {policy}"
    table.caption = (
        "view: number, elevation, azimuth; travel: around the object; "
        f"stops by {result.stopping}"
    )

    for column in columns:
        justify: JustifyMethod = "right" if column in ("step", "travel") else "left"
        table.add_column(column, justify=justify, no_wrap=True)
    if frames:  # their names may be long
        table.columns[1].no_wrap = False
        table.columns[1].overflow = "fold"
        table.columns[1].min_width = 9
        table.columns[1].max_width = 12

    for row, view in enumerate(result.views):
        looked = _angles(view.index, view.angles)
        if frames:
            looked += f"\n{frames[row]}\n{view.degrees_off:.1f}° off"

        own = int(view.alone.argmax())
        alone = "nothing\nis seen"
        if view.observation.seen:
            alone = f"{result.classes[own]}\n{view.alone[own]:.3f}"

        top = np.argsort(-view.belief)[:3]
        belief = "\n".join(f"{result.classes[c]} {view.belief[c]:.3f}" for c in top)
        after = "stop"
        if view.next_view is not None:
            after = _angles(view.next_view, result.sphere.angles(view.next_view))
        cells = {
            "step": str(row + 1),
            "view": looked,
            "this view alone": alone,
            "belief, top 3": belief,
            "stops at": f"{stops[row]:.2f}",
            "next": after,
            "travel": f"{np.degrees(view.arc):.0f}°",
        }
        table.add_row(*(cells[column] for column in columns))
    return table


def _answer_in_words(result: Recognition, has_threshold: bool) -> Text:
    """Describe the answer, or that the object is unknown, and the number of views."""
    effort = f"after {result.effort_in_words}"
    if result.unknown:
        why = f": {printable(result.why_unknown)}, {effort}."
        return Text.assemble("It is ", (printable(result.none_of_them), "bold"), why)

    reason = f"not confident: {printable(result.doubt)}"
    if result.stranded:
        reason = "no other view in reach"
    if result.confident:
        reason = "threshold reached" if has_threshold else f"{result.stopping}"
    rest = f"{result.views[-1].belief.max():.3f}, {effort} ({reason})."
    return Text.assemble(
        "Answer: ",
        (printable(f"{result.answer}"), "bold"),
        ", belief ",
        rest,
    )


def _pose_in_words(result: Recognition) -> list[str]:
    """Describe the pose of the object, or why it is not known, one line each."""
    if result.pose is None:
        return (
            [f"Its pose is not known: {printable(result.why_no_pose)}."]
            if result.why_no_pose
            else []
        )

    others = [
        each
        for each in result.pose_candidates
        if not np.array_equal(each.pose, result.pose)
    ]
    rows = [" ".join(f"{value:9.4f}" for value in row) for row in result.pose]
    lines = [
        f"From the frame of its scan into {result.poses_in}, metres ({result.pose_uncertainty}):",
        *rows,
    ]

    if others:
        alike = ", ".join(
            f"{printable(each.thing)} {each.probability:.2f}"
            for each in others[:SHOWN_POSES]
        )
        more = ", ..." if len(others) > SHOWN_POSES else ""
        lines.append(
            f"Other poses that it may have, by their probability: {alike}{more}."
        )
    return lines
