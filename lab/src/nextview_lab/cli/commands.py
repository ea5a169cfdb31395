"""The table of commands. The function of a command is imported only when it is called."""

from nextview.cli.commands import Command, Program
from nextview_lab import __version__
from nextview_lab.extras import EXTRAS

CLI = "nextview_lab.cli"
TRAINING = "nextview_lab.training"
THESIS = f"{TRAINING}.recipes:THESIS"
EXPORT = f"{TRAINING}.export:export"
EXPORTED = (
    "{found.card}: largest difference between torch and ONNX "
    "on real views {found.difference:.2g}"
)
MORE_POLICIES = (
    "tables and figures are in {out}; one more policy: the same command with --policies"
)
COMMANDS = {
    "capture": Command(
        f"{CLI}.capture:capture",
        "write depth images of a mesh, in the layout of BOP",
        computes=False,
        example="capture samples/chair.off captured --unit cm --table",
    ),
    "download": Command(
        f"{CLI}.download:download",
        "download ModelNet10 or ModelNet40",
        computes=False,
        example="download modelnet10 data",
    ),
    "render": Command(
        f"{CLI}.stores:render",
        "render every view of a dataset into a view store",
        changes="store",
        example="render data/ModelNet10 views.zarr --unit inch",
    ),
    "measure": Command(
        f"{CLI}.stores:measure",
        "compute measures of the views in a store",
        changes="store",
        example="measure views.zarr --measures depth_entropy",
    ),
    "train recogniser": Command(
        f"{TRAINING}.recogniser_training:train_recogniser",
        "train a recogniser",
        "next: nextview-lab export recogniser {out} {store} MODELS",
        thesis=f"{THESIS}_RECOGNISER",
        example="train recogniser views.zarr runs/recogniser --epochs 30",
    ),
    "train map": Command(
        f"{TRAINING}.map_training:train_map",
        "train a network that predicts a measure of views",
        "next: nextview-lab export map {out} {store} MODELS",
        thesis=f"{THESIS}_MAP",
        example="train map views.zarr runs/lem --measure depth_entropy",
    ),
    "train segmentation": Command(
        f"{TRAINING}.segmentation_training:train_segmentation",
        "train the network that segments frames into objects",
        "next: nextview-lab export segmentation {out} MODELS",
        example="train segmentation runs/segmentation --frames 12000",
    ),
    "train gain": Command(
        f"{TRAINING}.gain_training:train_gain",
        "train the policy that predicts the gain of a view",
        "on objects of other folds the {recipe.objective} after"
        " 2, 3, ... views is {found.value} at travel weight 0; travel weight"
        " {found.travel_weight:g}: {found.card}; in {found.states} states its answers differ from"
        " the networks' by {found.difference:.1g} at most",
        example="train gain validation.npz models/gain.json",
    ),
    "export recogniser": Command(
        f"{EXPORT}_recogniser",
        "export a trained recogniser as a model",
        EXPORTED,
        example="export recogniser runs/recogniser views.zarr models",
    ),
    "export segmentation": Command(
        f"{TRAINING}.segmentation_export:export_segmentation",
        "export a trained segmentation network",
        "{found.card}: largest difference between torch and ONNX on simulated frames"
        " {found.difference:.2g}",
        example="export segmentation runs/segmentation models",
    ),
    "export map": Command(
        f"{EXPORT}_map",
        "export a trained map network as a model",
        EXPORTED,
        example="export map runs/lem views.zarr models --bits 8",
    ),
    "predict": Command(
        f"{CLI}.stores:predict",
        "run the models once over every view of a store",
        example="predict views.zarr test.npz --split test --models models",
    ),
    "fit calibration": Command(
        f"{TRAINING}.card_fits:fit_calibration",
        "calibrate a recogniser's belief",
        "{found.objects} objects: temperature of one view {found.calibration.temperature},"
        " correlation of two views {found.calibration.correlation}; negative log-likelihood over 1"
        " to 5 views {found.before:.3f} before, {found.after:.3f} after",
        changes="card",
        example="fit calibration validation.npz models/recogniser-modelnet10.json",
    ),
    "fit size": Command(
        f"{TRAINING}.card_fits:fit_size",
        "fit the sizes of the objects of each class",
        "sizes of {found.objects} objects; by {found.weighed_on} others, weight beside the logits"
        " {found.size.weight:.2f}; negative log-likelihood of single views {found.before:.3f} by"
        " shape alone, {found.after:.3f} with the size",
        changes="card",
        example="fit size views.zarr validation.npz models/recogniser-modelnet10.json",
    ),
    "fit unknown": Command(
        f"{TRAINING}.unknown:fit_unknown",
        "fit the detection of objects of unknown classes",
        "views of {found.objects} known objects; false-alarm rates by {found.held_out} others; "
        "meshes left out: {found.left_out}",
        changes="card",
        example="fit unknown data/ModelNet10 models/recogniser-modelnet10.json",
    ),
    "fit valleys": Command(
        f"{TRAINING}.card_fits:fit_valleys",
        "choose the classes that use the valley of a map",
        "{found.objects} objects: the valley is better for these classes: {found.classes}",
        changes="card",
        example="fit valleys validation.npz models/lem-modelnet10.json",
    ),
    "evaluate": Command(
        "nextview_lab.benchmark.evaluation_page:write_evaluation",
        "evaluate a recogniser and its maps on every view",
        "tables and evaluate.html are in {out}",
        example="evaluate test.npz evaluation",
    ),
    "benchmark classes": Command(
        "nextview_lab.benchmark.classes:benchmark_classes",
        "compare next-view policies on objects of known classes",
        "next: nextview-lab report {out}",
        f"{CLI}.benchmark_tables:print_classes",
        example="benchmark classes test.npz results --policies random gain",
    ),
    "benchmark things": Command(
        "nextview_lab.benchmark.things:benchmark_things",
        "compare next-view policies on taught things",
        MORE_POLICIES,
        f"{CLI}.benchmark_tables:print_compared",
        example="benchmark things samples compared --unit cm --views 1 2 3",
    ),
    "benchmark tables": Command(
        "nextview_lab.benchmark.tables:benchmark_tables",
        "compare next-view policies on tables with several things",
        MORE_POLICIES,
        f"{CLI}.benchmark_tables:print_compared",
        example="benchmark tables scans strangers tables --tables 10",
    ),
    "bop": Command(
        "nextview_lab.benchmark.bop:look_for_models",
        "locate the models of a BOP dataset in its images",
        "wrote {out}; next: evaluate it with bop_toolkit",
        f"{CLI}.printing:print_bop",
        example="bop lmo nextview_lmo-test.csv --models lmo_memory",
    ),
    "real": Command(
        "nextview_lab.benchmark.real:recognise_real",
        "compare what is said of real frames with the truth",
        "wrote {out}, a line for each thing",
        f"{CLI}.printing:print_real",
        example="real ycbv/test/000048 my_frames --out real.csv --models mine",
    ),
    "submit": Command(
        "nextview_lab.benchmark.submit:submit",
        "run a method over a frozen archive of episodes",
        "wrote {out}; next: nextview-lab leaderboard FOLDER {archive} OUT",
        example="submit nextview-bench-1.0 results/random.json --policy random",
    ),
    "leaderboard": Command(
        "nextview_lab.benchmark.standings:leaderboard_of",
        "compare methods on a frozen archive of episodes",
        "the tables are in {out}",
        f"{CLI}.benchmark_tables:print_compared",
        computes=False,
        example="leaderboard results nextview-bench-1.0 board",
    ),
    "report": Command(
        "nextview_lab.benchmark.report:report",
        "write one HTML page of a benchmark of classes",
        "{found}",
        computes=False,
        example="report results",
    ),
    "explore": Command(
        f"{CLI}.explore:explore",
        "show the objects of a view store in the browser",
        example="explore views.zarr",
    ),
    "completion": Command(
        f"{CLI}.completion:completion",
        "print a completion script for bash, zsh or fish",
        example="completion bash",
        computes=False,
    ),
}
OTHER_WORDS = {  # by command: what a newcomer may call it
    "capture": ("simulate photograph shoot take record"),
    "download": ("fetch get install dataset data"),
    "evaluate": ("score accuracy metrics"),
    "benchmark classes": ("compare bench"),
    "leaderboard": ("ranking rank"),
    "report": ("page html"),
}
LABORATORY = Program(
    "nextview-lab",
    "The laboratory of nextview: data sets, training, benchmarks.",
    __version__,
    COMMANDS,
    (
        "render",
        "measure",
        "predict",
        "train recogniser",
        "train map",
        "train segmentation",
        "bop",
        "real",
        "submit",
        "benchmark things",
        "benchmark tables",
    ),
    OTHER_WORDS,
    extras=EXTRAS,
)
