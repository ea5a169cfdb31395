"""A rule about all objects of a scene: names that an object cannot have beside the others."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from nextview.checks import one_line, plugin_errors
from nextview.errors import UsageError
from nextview.scene.objects import SceneObject

SceneRule = Callable[[Sequence[SceneObject]], Mapping[int, Mapping[str, str]]]
"""A function of all objects of a scene that returns, by the number of an object, the names that it
cannot have, each with the reason in words. It is asked after each frame, and again with the names
that the objects have without these, until it rules out no other name.
"""


def ruled_out_by(
    rule: SceneRule,
    objects: Sequence[SceneObject],
) -> dict[int, dict[str, str]]:
    """Ask a rule which further names it rules out.

    Args:
        rule: the rule.
        objects: all objects of a scene.

    Returns:
        By number of the object, names that are not ruled out yet, with the reasons; only objects
        with such names.

    Raises:
        UsageError: the rule raises, or returns anything else.
    """
    with plugin_errors(lambda said: UsageError(f"the rule of the scene raised {said}")):
        said = rule(objects)

    known = {one.number: dict(one.ruled_out) for one in objects}
    if not isinstance(said, Mapping) or not set(said) <= set(known):
        raise UsageError(
            "the rule of a scene returns names by the number of an object, not"
            f" {one_line(repr(said))}"
        )

    found = {}
    for number, names in said.items():
        if not isinstance(names, Mapping):
            raise UsageError(
                "the rule of a scene gives the reason for each name, {name: reason}, not"
                f" {one_line(repr(names))}"
            )
        new = {str(a): str(b) for a, b in names.items() if a not in known[number]}
        if new:
            found[number] = new
    return found
