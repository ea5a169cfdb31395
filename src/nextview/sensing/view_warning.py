"""Warnings about likely problems of a view."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ViewWarning:
    """A likely problem of a view or a frame, in a sentence.

    Names are "nothing seen", "opengl axes", "ros axes", "inverse pose", "scale", "outside",
    "contradiction" and "repeated"; for frames "intrinsics", "unit", "far origin", "pose",
    "support", "point", "size", "stale pose", "displaced", "lean" and "camera". The
    warnings of scenes are listed on the page about tables.

    Attributes:
        name: one of these.
        message: a sentence for the person who set up the camera.
        holds: whether the warning blocks a confident answer. It is False if the problem is
            corrected, or irrelevant for the answer.
    """

    name: str
    message: str
    holds: bool = True
