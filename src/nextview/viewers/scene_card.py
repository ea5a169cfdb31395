"""HTML summary of the objects in a scene, and a static page with a picture.

The page is one file without scripts, and needs no optional dependencies.
"""

from __future__ import annotations

import base64
from html import escape
from pathlib import Path

from nextview.errors import SessionError
from nextview.figures.style import FAINT, INK, PAPER
from nextview.files import new_file
from nextview.recognition.poses import place_in_words
from nextview.scene.objects import UNKNOWN_NAME, SceneObject
from nextview.scene.scene import Scene
from nextview.viewers.scene_shapes import colour_of

PAGE_CANDIDATES = 4  # listed candidates per object
LEAST_BELIEF = 0.005  # smaller beliefs are not shown
PANEL = f"""<style>
.nv {{ position: fixed; z-index: 9; top: 0; right: 0; bottom: 0; width: 330px; overflow-y: auto;
  box-sizing: border-box; padding: 14px 16px; background: {PAPER}; color: {INK};
  border-left: 1px solid {FAINT}; font: 13px/1.35 "Helvetica Neue", Arial, sans-serif }}
.nv h1 {{ font-size: 18px; margin: 0 0 2px }}
.nv p {{ color: #5b6672; margin: 0 0 12px }}
.nv section {{ border-top: 1px solid {FAINT}; padding: 8px 0 }}
.nv h2 {{ font-size: 14px; margin: 0 0 2px }}
.nv h2 i {{ display: inline-block; width: 11px; height: 11px; border-radius: 3px;
  margin-right: 7px }}
.nv h2 small {{ font-weight: normal; color: #5b6672 }}
.nv small {{ color: #5b6672; font-size: 13px; overflow-wrap: anywhere }}
.nv table {{ border-spacing: 0 2px; width: 100% }}
.nv td:first-child {{ width: 130px; overflow-wrap: anywhere }}
.nv td:last-child {{ width: 44px; text-align: right; font-variant-numeric: tabular-nums }}
.nv .bar {{ height: 9px; background: #eef1f4 }}
.nv .bar b {{ display: block; height: 9px }}
#root {{ right: 330px !important; width: calc(100% - 330px) !important }}
@media (max-width: 700px) {{
  .nv {{ top: 55%; width: 100%; border: 0; border-top: 1px solid {FAINT} }}
  #root {{ right: 0 !important; width: 100% !important; height: 55% !important }}
}}
</style>"""
PICTURE_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<title>{title} - nextview</title>
<style>
body {{ margin: 0; background: {paper} }}
#root {{ position: fixed; top: 0; left: 0; bottom: 0; display: flex; align-items: center;
  justify-content: center; box-sizing: border-box; padding: 20px }}
#root img {{ max-width: 100%; max-height: 100% }}
</style>
</head>
<body>
<div id="root"><img src="data:image/png;base64,{picture}"
  alt="the last frame with names and poses, and the table from above"></div>
{card}
</body>
</html>
"""


def write_picture_page(
    scene: Scene,
    path: str | Path,
    picture: str | Path,
    title: str = "On the table",
    overwrite: bool = False,
) -> None:
    """Write a page with a picture of a scene, and the name, position and beliefs of each object.

    Args:
        scene: with at least one frame.
        path: of the page, .html.
        picture: PNG file, which is embedded in the page.
        title: heading of the page.
        overwrite: whether to replace an existing page.

    Raises:
        SessionError: the scene has no frame yet.
        ResultsError: the page exists, or cannot be written.
    """
    if not scene.frames:
        raise SessionError(
            "there is nothing to show before the first frame: update with one"
        )
    shown = base64.b64encode(Path(picture).read_bytes()).decode()
    text = PICTURE_PAGE.format(
        title=escape(title),
        paper=PAPER,
        picture=shown,
        card=scene_card(scene, title),
    )
    with new_file(Path(path), overwrite) as part:
        part.write_text(text, encoding="utf-8")


def scene_card(scene: Scene, title: str) -> str:
    """Return the summary of all objects as HTML.

    Args:
        scene: with at least one frame.
        title: of the scene.
    """
    objects = scene.objects
    count = len(scene.frames)
    frames = f"{count} frame{'s' * (count > 1)}"
    sure = sum(thing.confident for thing in objects)
    unknown = sum(thing.name == UNKNOWN_NAME for thing in objects)
    doubtful = len(objects) - sure - unknown
    said = f"{frames}: {sure} confident, {doubtful} not confident, {unknown} unknown"
    if not objects:
        said = f"{frames}: nothing stands on the plane"
    parts = "".join(_object_card(thing) for thing in objects)
    # can be focused with Tab and scrolled without a mouse
    panel = '<div class="nv" role="region" aria-label="what was found" tabindex="0">'
    return f"{PANEL}{panel}<h1>{escape(title)}</h1><p>{said}</p>{parts}</div>"


def _object_card(thing: SceneObject) -> str:
    """Return the summary of an object as HTML."""
    colour = colour_of(thing)
    sure = "confident" if thing.confident else "not confident"
    off = thing.pose_uncertainty
    where = f"at {place_in_words(thing.place)}"
    if thing.name == UNKNOWN_NAME:
        sides = " x ".join(f"{100 * side:.0f}" for side in thing.size)
        sure = f"{sides} cm"
    elif off is not None:
        where += f", ± {off.millimetres:.1f} mm, {off.degrees:.1f}°"
    if thing.touches:
        where += f", touches {', '.join(str(number) for number in thing.touches)}"

    beliefs = sorted(thing.beliefs.items(), key=lambda pair: -pair[1])[:PAGE_CANDIDATES]
    rows = "".join(
        f'<tr><td>{escape(name.replace("_", " "))}</td><td><div class="bar">'
        f'<b style="width:{100 * belief:.1f}%;background:{colour}"></b></div></td>'
        f"<td>{belief:.1%}</td></tr>"
        for name, belief in beliefs
        if belief >= LEAST_BELIEF
    )
    warnings = "".join(
        f"<br>{escape(text)}" for text in sorted({w.message for w in thing.warnings})
    )
    name = escape(thing.name.replace("_", " "))
    return (
        f'<section><h2><i style="background:{colour}"></i>{thing.number} {name}'
        f" <small>{sure}</small></h2><table>{rows}</table>"
        f"<small>{where}{warnings}</small></section>"
    )
