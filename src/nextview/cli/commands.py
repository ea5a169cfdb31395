"""The commands of ``nextview`` by name; each is one file beside this one."""

from __future__ import annotations

from typing import Any

from nextview.cli.benchmark import benchmark
from nextview.cli.capture import capture
from nextview.cli.check import check
from nextview.cli.completion import completion
from nextview.cli.correspond import correspond
from nextview.cli.demo import demo
from nextview.cli.download import download
from nextview.cli.evaluate import evaluate
from nextview.cli.explore import explore
from nextview.cli.export import export_recogniser
from nextview.cli.export_maps import export_lcm, export_lem, export_map
from nextview.cli.fit import fit_calibration, fit_size, fit_valleys
from nextview.cli.fit_policies import fit_policies
from nextview.cli.fit_unknown import fit_unknown
from nextview.cli.fit_visibility import fit_visibility
from nextview.cli.inspect import inspect
from nextview.cli.measure import measure
from nextview.cli.measures import measures
from nextview.cli.models import models
from nextview.cli.plan import plan
from nextview.cli.predict import predict
from nextview.cli.recognise import recognise
from nextview.cli.render import render
from nextview.cli.report import report
from nextview.cli.train_agent import train_agent
from nextview.cli.train_gain import train_gain
from nextview.cli.train_grid import train_grid
from nextview.cli.train_maps import train_lcm, train_lem, train_map
from nextview.cli.train_recogniser import train_recogniser
from nextview.cli.worlds import worlds

COMMANDS: dict[str, Any] = {
    "recognise": recognise,
    "demo": demo,
    "explore": explore,
    "capture": capture,
    "models": models,
    "download": download,
    "worlds": worlds,
    "render": render,
    "check": check,
    "measure": measure,
    "measures": measures,
    "plan": plan,
    "correspond": correspond,
    "inspect": inspect,
    "train": {
        "recogniser": train_recogniser,
        "grid": train_grid,
        "map": train_map,
        "lem": train_lem,
        "lcm": train_lcm,
        "gain": train_gain,
        "agent": train_agent,
    },
    "export": {"recogniser": export_recogniser, "map": export_map, "lem": export_lem, "lcm": export_lcm},
    "predict": predict,
    "fit": {
        "size": fit_size,
        "calibration": fit_calibration,
        "visibility": fit_visibility,
        "unknown": fit_unknown,
        "valleys": fit_valleys,
        "policies": fit_policies,
    },
    "evaluate": evaluate,
    "benchmark": benchmark,
    "report": report,
    "completion": completion,
}
GROUPS = {
    "train": "Train a network on a view store.",
    "export": "Turn a training run into an ONNX model with a card.",
    "fit": "Fit what sizes mean, a recogniser's calibration, what it does not know, a map's valleys, simple policies.",
}
