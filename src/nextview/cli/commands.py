"""The table of commands. The function of a command is imported only when it is called."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from nextview import __version__
from nextview.checks import EXTRAS


@dataclass(frozen=True)
class Command:
    """A command: the function whose parameters are its options and whose docstring is its help.

    Attributes:
        function: MODULE:NAME of the function that runs the command.
        line: one-line description for the list of all commands.
        then: text printed at the end; names in braces are arguments, and ``found`` is the return
            value of the function.
        show: MODULE:NAME of the function that prints the return value.
        thesis: MODULE:NAME of the recipe that --preset thesis selects.
        changes: name of the parameter of a file or folder that is changed; see also
            ``OUTPUT_NAMES``.
        example: arguments of an example, printed at the end of its help.
        computes: whether its help says how many cores it uses.
    """

    function: str
    line: str
    then: str = ""
    show: str = ""
    thesis: str = ""
    changes: str = ""
    example: str = ""
    computes: bool = True


@dataclass(frozen=True)
class Program:
    """A program: its commands, and what it prints about itself.

    Attributes:
        name: as it is called in a shell.
        about: one sentence that describes it.
        version: of its distribution.
        commands: by name, in the order of the printed list.
        resumes: commands that continue an interrupted run.
        other_words: what a newcomer may call a command, by its name; words separated by spaces.
        elsewhere: first words of the commands of another program, and its name.
        extras: packages by the optional part of the installation that brings them.
    """

    name: str
    about: str
    version: str
    commands: Mapping[str, Command]
    resumes: tuple[str, ...]
    other_words: Mapping[str, str]
    elsewhere: tuple[tuple[str, ...], str] = ((), "")
    extras: Mapping[str, tuple[str, ...]] = field(default_factory=lambda: EXTRAS)


# parameters, and fields of parameters, that name what a command writes
OUTPUT_NAMES = ("out", "figure", "figures", "explorer", "record")
CLI = "nextview.cli"
COMMANDS = {
    "recognise": Command(
        f"{CLI}.recognise:recognise",
        "recognise the object of a mesh or of captured frames",
        example="recognise samples/table.off --unit cm --sensor wrist",
    ),
    "look": Command(
        f"{CLI}.look:look",
        "name and locate all known things on a table",
        example="look nextview_demo/recording --figure table.png",
    ),
    "demo": Command(
        f"{CLI}.demo:demo",
        "name and locate everything on a bundled table",
        example="demo --out my_demo",
    ),
    "demo-episode": Command(
        f"{CLI}.demo:demo_episode",
        "recognise sample furniture and draw the episode",
        example="demo-episode --shape chair --figure chair.png",
    ),
    "learn": Command(
        "nextview.teaching.learn:learn_things",
        "learn your objects from scans or depth frames",
        "{found}\nnext: nextview recognise MESH --models {out}; what was learned is drawn in"
        " {out}/learned.png",
        example="learn samples mine --unit cm",
    ),
    "explore": Command(
        f"{CLI}.explore:explore",
        "choose views in the browser and watch the belief",
        example="explore samples --unit cm",
    ),
    "completion": Command(
        f"{CLI}.completion:completion",
        "print a completion script for bash, zsh or fish",
        computes=False,
        example="completion bash",
    ),
    "list": Command(
        f"{CLI}.listing:show",
        "list the bundled models",
        computes=False,
        example="list models",
    ),
    "check": Command(
        f"{CLI}.check:check",
        "check captured frames and cameras",
        example="check nextview_demo/recording",
    ),
}
OTHER_WORDS = {  # by command: what a newcomer may call it
    "recognise": ("classify identify infer run what who"),
    "look": (
        "locate localise localize detect find search segment scan pose poses estimate"
        " objects scene table bin watch see analyse analyze process"
    ),
    "demo": ("example examples try start quickstart tutorial hello sample samples"),
    "learn": (
        "teach teach-in train train-on fit add enrol enroll register memorise memorize"
        " remember import scan"
    ),
    "explore": ("gui show visualise visualize view viewer browser web ui"),
    "completion": ("autocomplete tab"),
    "list": ("models ls measures info"),
    "check": ("verify validate test inspect doctor calibrate calibration"),
}
LAB = (
    "download",
    "capture",
    "scenes",
    "render",
    "measure",
    "train",
    "export",
    "predict",
    "fit",
    "evaluate",
    "benchmark",
    "bop",
    "real",
    "submit",
    "leaderboard",
    "report",
)
NEXTVIEW = Program(
    "nextview",
    "Active 3D object recognition: what an object is, and where to look next.",
    __version__,
    COMMANDS,
    ("learn",),
    OTHER_WORDS,
    (LAB, "nextview-lab"),
)
