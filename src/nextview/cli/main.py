"""The ``nextview`` command: each subcommand is one file beside this one."""

from __future__ import annotations

import sys

import tyro

from nextview.cli.benchmark import benchmark
from nextview.cli.demo import demo
from nextview.cli.export import export_lem, export_recogniser
from nextview.cli.models import models
from nextview.cli.predict import predict
from nextview.cli.recognise import recognise
from nextview.cli.render import render
from nextview.cli.report import report
from nextview.cli.train import train_lem, train_recogniser

COMMANDS = {
    "recognise": recognise,
    "demo": demo,
    "models": models,
    "render": render,
    "train recogniser": train_recogniser,
    "train lem": train_lem,
    "export recogniser": export_recogniser,
    "export lem": export_lem,
    "predict": predict,
    "benchmark": benchmark,
    "report": report,
}
