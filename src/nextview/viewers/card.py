"""HTML summary of a walk's last view."""

from base64 import b64encode
from collections.abc import Iterable
from html import escape
from io import BytesIO

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from nextview.figures.style import ACCENT, FAINT, GROUND, INK, WOOD, heat, rgb
from nextview.geometry.viewsphere import ViewSphere, direction_of
from nextview.recognition.poses import place_in_words
from nextview.sensing.observation import Observation
from nextview.session.view import View
from nextview.types import Float, Mask
from nextview.viewers.exploration import Walk
from nextview.views.expected_views import RivalPictures

MAP_CELL = 11  # side of a cell of a map, pixels
SHOWN_CLASSES = 5  # number of listed classes
CARD_STYLE = f"""<style>
.nv {{ font: 13px sans-serif; color: {INK}; padding: 0.4em 0.8em 0.8em }}
.nv h3 {{ margin: 0 0 0.1em; font-size: 20px }}
.nv h3 small {{ color: {ACCENT}; font-size: 17px }}
.nv p {{ margin: 0.2em 0 0.7em; color: #5b6672 }}
.nv p small {{ font-size: inherit }}
.nv img {{ image-rendering: pixelated; vertical-align: top; border-radius: 5px; margin-bottom: 4px }}
.nv figure {{ display: inline-block; margin: 0 10px 8px 0; vertical-align: top; color: #5b6672 }}
.nv figcaption {{ width: 0; min-width: 100%; overflow-wrap: anywhere }}
.nv table {{ border-spacing: 0 3px; width: 100% }}
.nv td {{ padding: 0 4px; white-space: nowrap; font-variant-numeric: tabular-nums }}
.nv .bar {{ position: relative; height: 13px; width: 120px; background: #eef1f4 }}
.nv .bar i {{ position: absolute; left: 0; display: block }}
.nv .bar b {{ position: absolute; top: -2px; bottom: -2px; border-left: 2px dotted {INK} }}
</style>"""


def walk_card(walk: Walk) -> str:
    """Return the summary of a walk: image, maps and values, belief before and after, and all views."""
    if not walk.views:
        return (
            f'{CARD_STYLE}<div class="nv"><p>No view was taken yet. The policy begins at view'
            f" {walk.start}.</p></div>"
        )

    view = walk.views[-1]
    classes = walk.session.models.classes
    best = int(view.belief.argmax())
    believed = f"{escape(classes[best])} <small>{view.belief[best]:.1%}</small>"
    believed = believed if view.observation.seen else "Nothing is seen"
    goes_on = (
        "It would stop here."
        if walk.stopped
        else "Not confident yet: another view is needed."
    )

    parts = [
        f"<h3>{believed}</h3><p>{goes_on}</p>",
        _pose(walk),
        _figures(walk, view),
        _beliefs(walk),
    ]
    at = walk.next_view
    if at is not None:
        parts.append(geometry_card(walk, walk.sphere.directions[at], f"view {at}"))
    parts += [_maps(view), _steps(walk)]
    return f'{CARD_STYLE}<div class="nv">{"".join(parts)}</div>'


def _pose(walk: Walk) -> str:
    """Return the pose of the object, or why it is not known; "" for models without geometry."""
    result = walk.session.result
    if result.why_no_pose:
        return f"<p>No pose: {escape(result.why_no_pose)}.</p>"
    if result.place is None:
        return ""
    likely = max(each.probability for each in result.pose_candidates)
    count = len(result.pose_candidates)
    several = f", the likeliest of {count} poses ({likely:.0%})" if count > 1 else ""
    return (
        f"<p>At {place_in_words(result.place)} in {result.poses_in},"
        f" {result.pose_uncertainty}{several}.</p>"
    )


def preview_card(observation: Observation, walk: Walk) -> str:
    """Describe the preview of a camera that is being dragged.

    Args:
        observation: preview from the camera.
        walk: the walk.

    Returns:
        HTML: the image, and the two leading hypotheses as the camera would show them.
    """
    rivals = geometry_card(walk, direction_of(observation.pose), "this camera")
    parts = f"<h3>From here</h3>{_image(observation.picture, 200)}{rivals}"
    return f'{CARD_STYLE}<div class="nv">{parts}</div>'


def class_card(label: str) -> str:
    """Return the true class of the object."""
    return f'{CARD_STYLE}<div class="nv">Its class is <b>{escape(label)}</b>; no policy knows.</div>'


def warm(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Colour a grey image, (H, W), as (H, W, 3): objects on a ground; black is empty."""
    wood = np.minimum(
        np.array(rgb(WOOD)) * np.minimum(picture[..., None] / 200, 1.15),
        255,
    )
    return np.where(picture[..., None] > 0, wood, rgb(GROUND)).astype(np.uint8)


def _image(pixels: NDArray[np.uint8], width: int) -> str:
    file = BytesIO()
    Image.fromarray(warm(pixels) if pixels.ndim == 2 else pixels).save(file, "png")
    return f'<img width="{width}" src="data:image/png;base64,{b64encode(file.getvalue()).decode()}">'


def _figures(walk: Walk, view: View) -> str:
    """Return the image, and the value of each view if views lie on rings, the highest ring on top."""
    elevation, azimuth = view.angles
    where = (
        f"from view {view.index}, {elevation:.0f}° up, {round(azimuth) % 360}° around"
    )
    found = [(where, _image(view.observation.picture, 160))]
    if view.values is not None and isinstance(walk.sphere, ViewSphere):
        grid = view.values.reshape(walk.sphere.rings, walk.sphere.azimuths)
        order = np.argsort(walk.sphere.elevations)[::-1]
        found.append(
            ("value of each view", _image(heat(grid[order]), MAP_CELL * grid.shape[1]))
        )
    return _captioned(found)


def _maps(view: View) -> str:
    found = [
        (name, _image(heat(values[::-1]), MAP_CELL * values.shape[1]))
        for name, values in view.maps.items()
    ]
    return (
        f"<p>Maps of the views around this one:</p>{_captioned(found)}" if found else ""
    )


def _captioned(images: Iterable[tuple[str, str]]) -> str:
    return "".join(
        f"<figure>{image}<figcaption>{escape(below)}</figcaption></figure>"
        for below, image in images
    )


def _table(rows: Iterable[Iterable[str]]) -> str:
    cells = ("".join(f"<td>{cell}</td>" for cell in row) for row in rows)
    return f"<table>{''.join(f'<tr>{row}</tr>' for row in cells)}</table>"


def geometry_card(walk: Walk, direction: Float, what: str) -> str:
    """Render the two leading hypotheses from a direction, (3,), and mark their differences.

    Empty if no geometry is known, or only one hypothesis is left.

    Args:
        walk: the episode so far.
        direction: from the object to the camera, (3,).
        what: name of the view, for the heading.
    """
    rivals = walk.rival_pictures(direction)
    outlook = walk.session.outlook
    if rivals is None or outlook is None:
        return ""

    names = [outlook.caster.surfaces[thing].name for thing in rivals.things]
    if names[0] == names[1]:
        names = [f"{names[0]}, likeliest pose", f"{names[1]}, second pose"]
    both = [
        (name, _image(picture, 128))
        for name, picture in zip(names, rivals.pictures, strict=True)
    ]
    both.append(("where they differ", _image(differing(rivals), 128)))

    return (
        f"<p>The two likeliest, as {what} would show them: they differ in {rivals.share:.0%} of"
        f" the pixels.</p>{_captioned(both)}"
    )


def differing(rivals: RivalPictures) -> NDArray[np.uint8]:
    """Blend both hypotheses faintly and highlight pixels in which they differ, (S, S, 3)."""
    either: Mask = np.asarray(rivals.pictures.any(0))
    drawn = np.where(either[..., None], rgb(FAINT), rgb(GROUND))
    return np.where(rivals.different[..., None], rgb(ACCENT), drawn).astype(np.uint8)


def _beliefs(walk: Walk) -> str:
    """Return the most likely classes: belief, belief from this view alone, and the change."""
    view = walk.views[-1]
    classes = walk.session.models.classes
    rows = []
    before = (
        walk.views[-2].belief
        if len(walk.views) > 1
        else np.full(len(classes), 1 / len(classes))
    )
    highest = np.maximum(view.belief, before) if len(walk.views) > 1 else view.belief
    counted = sum(view.observation.seen for view in walk.views)
    # an infinite threshold is not drawn
    threshold = 100 * float(walk.stopping.threshold_at(max(counted, 1)))
    mark = f'<b style="left:{threshold:.1f}%"></b>' if np.isfinite(threshold) else ""

    for c in np.argsort(-highest, kind="stable")[:SHOWN_CLASSES]:
        bars = (
            '<div class="bar"><i'
            f' style="top:0;height:8px;width:{100 * view.belief[c]:.1f}%;background:{ACCENT}"></i>'
            f'<i style="top:8px;height:5px;width:{100 * view.alone[c]:.1f}%;'
            f'background:{FAINT}"></i>'
            f"{mark}</div>"
        )
        rows.append(
            (
                escape(classes[c]),
                bars,
                f"{view.belief[c]:.1%}",
                f"{view.belief[c] - before[c]:+.1%}",
            )
        )
    legend = "red: belief · grey: by this view alone · dotted: enough to stop · right: change"
    return f"{_table(rows)}<p><small>{legend}</small></p>"


def _steps(walk: Walk) -> str:
    classes = walk.session.models.classes
    rows = []

    for step, view in enumerate(walk.views, 1):
        best = int(view.belief.argmax())
        warnings = ", ".join(warning.name for warning in view.warnings)
        believed = escape(classes[best]), f"{view.belief[best]:.1%}"
        rows.append(
            (
                f"{step}",
                f"view {view.index}",
                *believed,
                f"{view.travel:.2f} cells",
                escape(warnings),
            )
        )

    return _table(rows)
