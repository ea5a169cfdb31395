"""Words about commands: an example of each for its help, and what newcomers call it."""

from difflib import get_close_matches

from nextview.cli.commands import COMMANDS

EXAMPLES = {  # by command; each is printed at the end of the help, after "nextview"
    "recognise": "recognise samples/table.off --unit cm --sensor wrist",
    "look": "look nextview_demo/recording --figure table.png",
    "demo": "demo --out my_demo",
    "demo-episode": "demo-episode --shape chair --figure chair.png",
    "learn": "learn samples mine --unit cm",
    "explore": "explore samples --unit cm",
    "capture": "capture samples/chair.off captured --unit cm --table",
    "completion": "completion bash",
    "list": "list models",
    "download": "download modelnet10 data",
    "scenes": "scenes data/ModelNet10 light --levels light --split test",
    "render": "render data/ModelNet10 views.zarr --unit inch",
    "check": "check nextview_demo/recording",
    "measure": "measure views.zarr --measures depth_entropy",
    "train recogniser": "train recogniser views.zarr runs/recogniser --epochs 30",
    "train map": "train map views.zarr runs/lem --measure depth_entropy",
    "train segmentation": "train segmentation runs/segmentation --frames 12000",
    "train gain": "train gain validation.npz models/gain.json",
    "export recogniser": "export recogniser runs/recogniser views.zarr models",
    "export segmentation": "export segmentation runs/segmentation models",
    "export map": "export map runs/lem views.zarr models --bits 8",
    "predict": "predict views.zarr test.npz --split test --models models",
    "fit calibration": (
        "fit calibration validation.npz models/recogniser-modelnet10.json"
    ),
    "fit size": "fit size views.zarr validation.npz models/recogniser-modelnet10.json",
    "fit unknown": "fit unknown data/ModelNet10 models/recogniser-modelnet10.json",
    "fit valleys": "fit valleys validation.npz models/lem-modelnet10.json",
    "evaluate": "evaluate test.npz evaluation",
    "benchmark classes": "benchmark classes test.npz results --policies random gain",
    "benchmark things": "benchmark things samples compared --unit cm --views 1 2 3",
    "benchmark tables": "benchmark tables scans strangers tables --tables 10",
    "bop": "bop lmo nextview_lmo-test.csv --frames 10",
    "submit": "submit nextview-bench-1.0 results/random.json --policy random",
    "leaderboard": "leaderboard results nextview-bench-1.0 board",
    "report": "report results --figures figures",
}
OTHER_WORDS = {  # by command: what a newcomer may call it
    "recognise": "classify identify infer run what who",
    "look": (
        "locate localise localize detect find search segment scan pose poses estimate objects scene"
        " table bin watch see analyse analyze process"
    ),
    "demo": "example examples try start quickstart tutorial hello sample samples",
    "learn": (
        "teach teach-in train train-on fit add enrol enroll register memorise memorize remember"
        " import scan"
    ),
    "explore": "gui show visualise visualize view viewer browser web ui",
    "capture": "simulate photograph shoot take record",
    "completion": "autocomplete tab",
    "list": "models ls measures info",
    "download": "fetch get install dataset data",
    "check": "verify validate test inspect doctor calibrate calibration",
    "evaluate": "score accuracy metrics",
    "benchmark classes": "compare bench",
    "leaderboard": "ranking rank",
    "report": "page html",
}


def suggested_commands(word: str) -> str:
    """Return the commands that a word may stand for, as the next part of a sentence.

    >>> suggested_commands("localise")
    "; did you mean 'look' (name and locate all known things on a table)?"

    Args:
        word: that is no command; it may be misspelt.
    """
    meant: dict[str, list[str]] = {}
    for command, words in OTHER_WORDS.items():
        for other in words.split():
            meant.setdefault(other, []).append(command)
    known = {name for command in COMMANDS for name in (command, command.split()[0])}

    near = get_close_matches(word.lower(), [*sorted(known), *meant], 1, 0.6)
    if not near:
        return ""
    if near[0] in known and near[0] != word:
        return f"; did you mean {near[0]!r}?"
    commands = [f"{name!r} ({COMMANDS[name].line})" for name in meant.get(near[0], [])]
    return f"; did you mean {' or '.join(commands)}?" if commands else ""
