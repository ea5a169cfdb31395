"""The table of commands. The function of a command is imported only when it is called."""

from dataclasses import dataclass


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
        changes: name of a parameter, beside ``OUTPUT_NAMES``, whose file or folder is changed.
    """

    function: str
    line: str
    then: str = ""
    show: str = ""
    thesis: str = ""
    changes: str = ""


# parameters, and fields of parameters, that name what a command writes
OUTPUT_NAMES = ("out", "figure", "figures", "explorer", "record")
CLI = "nextview.cli"
TEACHING = "nextview.teaching"
TRAINING = "nextview.training"
THESIS = f"{TRAINING}.recipes:THESIS"
EXPORT = f"{TRAINING}.export:export"
EXPORTED = (
    "{found.card}: largest difference between torch and ONNX "
    "on real views {found.difference:.2g}"
)
MORE_POLICIES = (
    "tables and figures are in {out}; one more policy: the same command with --policies"
)
COMMANDS = {  # by name, in the order of the printed list
    "recognise": Command(
        f"{CLI}.recognise:recognise",
        "recognise the object of a mesh or of captured frames",
    ),
    "look": Command(
        f"{CLI}.look:look",
        "name and locate all known things on a table",
    ),
    "demo": Command(
        f"{CLI}.demo:demo",
        "name and locate everything on a bundled table",
    ),
    "demo-episode": Command(
        f"{CLI}.demo:demo_episode",
        "recognise sample furniture and draw the episode",
    ),
    "learn": Command(
        f"{TEACHING}.learn:learn_things",
        "learn your objects from scans or depth frames",
        "{found}\nnext: nextview recognise MESH --models {out}; what was learned is drawn in"
        " {out}/learned.png",
    ),
    "explore": Command(
        f"{CLI}.explore:explore",
        "choose views in the browser and watch the belief",
    ),
    "capture": Command(
        f"{CLI}.capture:capture",
        "write depth images of a mesh, in the layout of BOP",
    ),
    "completion": Command(
        f"{CLI}.completion:completion",
        "print a completion script for bash, zsh or fish",
    ),
    "list": Command(
        f"{CLI}.listing:show",
        "list the bundled models or the view measures",
    ),
    "download": Command(f"{CLI}.listing:download", "download ModelNet10 or ModelNet40"),
    "scenes": Command(f"{CLI}.scenes:scenes", "draw cluttered scenes or rooms"),
    "render": Command(
        f"{CLI}.stores:render",
        "render every view of a dataset into a view store",
        changes="store",
    ),
    "check": Command(
        f"{CLI}.check:check",
        "check captured frames and cameras, or a view store",
    ),
    "measure": Command(
        f"{CLI}.stores:measure",
        "compute measures of the views in a store",
        changes="store",
    ),
    "train recogniser": Command(
        f"{TRAINING}.recogniser_training:train_recogniser",
        "train a recogniser",
        "next: nextview export recogniser {out} {store} MODELS",
        thesis=f"{THESIS}_RECOGNISER",
    ),
    "train map": Command(
        f"{TRAINING}.map_training:train_map",
        "train a network that predicts a measure of views",
        "next: nextview export map {out} {store} MODELS",
        thesis=f"{THESIS}_MAP",
    ),
    "train segmentation": Command(
        f"{TRAINING}.segmentation_training:train_segmentation",
        "train the network that segments frames into objects",
        "next: nextview export segmentation {out} MODELS",
    ),
    "train gain": Command(
        f"{TRAINING}.gain_training:train_gain",
        "train the policy that predicts the gain of a view",
        "learned from {found.objects} objects; on {found.validated_on} the {recipe.objective} after"
        " 2, 3, ... views is {found.value} at travel weight 0; travel weight"
        " {found.travel_weight:g}: {found.card}; in {found.states} states its answers differ from"
        " the networks' by {found.difference:.1g} at most",
    ),
    "export recogniser": Command(
        f"{EXPORT}_recogniser",
        "export a trained recogniser as a model",
        EXPORTED,
    ),
    "export segmentation": Command(
        f"{TRAINING}.segmentation_export:export_segmentation",
        "export a trained segmentation network",
        "{found.card}: largest difference between torch and ONNX on simulated frames"
        " {found.difference:.2g}",
    ),
    "export map": Command(
        f"{EXPORT}_map",
        "export a trained map network as a model",
        EXPORTED,
    ),
    "predict": Command(
        f"{CLI}.predict:predict",
        "run the models once over every view of a store",
    ),
    "fit calibration": Command(
        f"{TRAINING}.card_fits:fit_calibration",
        "calibrate a recogniser's belief",
        "{found.objects} objects: temperature of one view {found.calibration.temperature},"
        " correlation of two views {found.calibration.correlation}; negative log-likelihood over 1"
        " to 5 views {found.before:.3f} before, {found.after:.3f} after",
        changes="card",
    ),
    "fit size": Command(
        f"{TRAINING}.card_fits:fit_size",
        "fit the sizes of the objects of each class",
        "sizes of {found.objects} objects; by {found.weighed_on} others, weight beside the logits"
        " {found.size.weight:.2f}; negative log-likelihood of single views {found.before:.3f} by"
        " shape alone, {found.after:.3f} with the size",
        changes="card",
    ),
    "fit unknown": Command(
        f"{TRAINING}.unknown:fit_unknown",
        "fit the detection of objects of unknown classes",
        "views of {found.objects} known objects; false-alarm rates by {found.held_out} others; "
        "meshes left out: {found.left_out}",
        changes="card",
    ),
    "fit valleys": Command(
        f"{TRAINING}.card_fits:fit_valleys",
        "choose the classes that use the valley of a map",
        "{found.objects} objects: the valley is better for these classes: {found.classes}",
        changes="card",
    ),
    "evaluate": Command(
        "nextview.benchmark.evaluation_page:write_evaluation",
        "evaluate a recogniser and its maps on every view",
        "tables and evaluate.html are in {out}",
        f"{CLI}.benchmark_tables:print_evaluation",
    ),
    "benchmark classes": Command(
        "nextview.benchmark.classes:benchmark_classes",
        "compare next-view policies on objects of known classes",
        "next: nextview report {out}",
        f"{CLI}.benchmark_tables:print_classes",
    ),
    "benchmark things": Command(
        "nextview.benchmark.things:benchmark_things",
        "compare next-view policies on taught things",
        MORE_POLICIES,
        f"{CLI}.benchmark_tables:print_compared",
    ),
    "benchmark tables": Command(
        "nextview.benchmark.tables:benchmark_tables",
        "compare next-view policies on tables with several things",
        MORE_POLICIES,
        f"{CLI}.benchmark_tables:print_compared",
    ),
    "bop": Command(
        "nextview.benchmark.bop:look_for_models",
        "locate the models of a BOP dataset in its images",
        "wrote {out}; next: evaluate it with bop_toolkit",
        f"{CLI}.bop:print_bop",
    ),
    "submit": Command(
        "nextview.benchmark.submit:submit",
        "run a method over a frozen archive of episodes",
        "wrote {out}; next: nextview leaderboard FOLDER {archive} OUT",
        f"{CLI}.submit:print_submitted",
    ),
    "leaderboard": Command(
        "nextview.benchmark.standings:leaderboard_of",
        "compare methods on a frozen archive of episodes",
        "the page is {out}/leaderboard.html",
        f"{CLI}.submit:print_leaderboard",
    ),
    "report": Command(
        "nextview.benchmark.report:report",
        "write one HTML page of a benchmark of classes",
        "{found}",
    ),
}
RESUMES = (  # commands that continue an interrupted run
    "render",
    "measure",
    "predict",
    "train recogniser",
    "train map",
    "train segmentation",
    "learn",
    "scenes",
    "bop",
    "submit",
    "benchmark things",
    "benchmark tables",
)
