"""What is likely to be wrong with a view, in words."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ViewWarning:
    """Something that is likely to be wrong, in a sentence.

    Names are "nothing seen", "opengl axes", "ros axes", "inverse pose", "scale", "outside",
    "contradiction" and "repeated"; of a frame "intrinsics", "unit", "far origin",
    "support", "point", "size", "stale pose", "displaced" and "lean". Those of scenes are on the
    page on tables.

    Attributes:
        name: one of these.
        message: a sentence for whoever set up the camera.
        holds: whether no answer is confident by a view with it. It is not so where the mistake is
            allowed for, or does not matter for the answer.
    """

    name: str
    message: str
    holds: bool = True
