"""Export a finished run of the segmentation network as an ONNX file and its card."""

from copy import deepcopy
from dataclasses import asdict
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from nextview.data.progress import TrackProgress, silently
from nextview.errors import ModelError
from nextview.files import command, new_folder, sha256_of, write_record
from nextview.segmentation.features import SIDE_MULTIPLE
from nextview.segmentation.network import (
    PICTURE_INPUT,
    PICTURE_OUTPUT,
    SegmentationNetwork,
    new_card,
)
from nextview_lab.data.labelled_frames import LabelledFrames, output_scores
from nextview_lab.data.progress import collected
from nextview_lab.extras import extras
from nextview_lab.training.architectures import SegmentationNet
from nextview_lab.training.export import Exported, check_new_model, export_onnx
from nextview_lab.training.recipes import SegmentationRecipe
from nextview_lab.training.runs import load_run, read_recipe, read_run
from nextview_lab.training.segmentation_training import files_of

with extras():
    import torch
    from torch import nn
    from torch.nn.utils.fusion import fuse_conv_bn_eval

LARGEST_DIFFERENCE = 0.01  # between the outputs of torch and of the file
FRAMES_COMPARED_WITH_TORCH = 4
WEIGHT_BITS = (16, 32)  # the first one that preserves the outputs is used


def export_segmentation(
    run: Path,
    out: Path,
    name: str = "segmentation",
    note: str = "",
    overwrite: bool = False,
    track: TrackProgress = silently,
) -> Exported:
    """Export a trained segmentation network to ONNX with a card of its validation scores.

    Args:
        run: folder of a run of nextview-lab train segmentation.
        out: folder for NAME.onnx and NAME.json.
        name: name of the network.
        note: text to add to the card.
        overwrite: replace an existing network.

    Raises:
        ModelError: the run is not finished or of another kind, or the file's outputs differ.
        DatasetError: the frames for validation are missing.
        ResultsError: the network exists.
    """
    check_new_model(out, name, overwrite)
    recipe = read_recipe(run, SegmentationRecipe)
    network = folded(load_run(SegmentationNet(recipe.width), run))
    frames = LabelledFrames.load([file.path for file in files_of(run, recipe)[1]])

    with new_folder(out, overwrite=True, last=f"{name}.json") as folder:
        part = folder / f"{name}.json"
        for bits in WEIGHT_BITS:
            _write_weights(network, frames, part, bits)
            judged = SegmentationNetwork(part)
            difference = largest_difference(network, judged, frames)
            if difference < LARGEST_DIFFERENCE:
                break
        else:
            raise ModelError(
                f"{name}: its outputs differ from the network's by up to {difference:.2g}; not"
                " written"
            )
        noted = read_run(run)
        scores = _scores(judged, frames, track)
        card = replace(
            judged.card,
            network=f"U-Net of width {recipe.width}, weights of {bits} bits",
            data=f"{recipe.frames} simulated frames of generated solids and of meshes",
            recipe=asdict(recipe),
            commands=(*noted.commands, command()),
            scores={f"validation ({len(frames)} simulated frames)": scores},
            largest_difference_to_torch=round(difference, 5),
            held_out=noted.held_out,
            note=note,
        )
        write_record(part, card, overwrite=True)
    return Exported(out / f"{name}.json", difference)


def _write_weights(
    network: SegmentationNet, frames: LabelledFrames, card: Path, bits: int
) -> None:
    """Write a network next to its card, which describes only inputs and outputs at this point."""
    weights = card.with_suffix(".onnx")
    weights.unlink(missing_ok=True)
    example = frames.example(0, None).features
    export_onnx(
        network,
        np.stack([example, example]),
        PICTURE_INPUT,
        [PICTURE_OUTPUT],
        weights,
        bits,
        SIDE_MULTIPLE,
    )
    write_record(card, new_card(card.stem, sha256_of(weights)), overwrite=True)


def folded(network: SegmentationNet) -> SegmentationNet:
    """Return a copy of a network, in evaluation mode, with batch norm folded into convolutions."""
    network = deepcopy(network).eval()
    for module in network.modules():
        for name, child in module.named_children():
            if isinstance(child, nn.Sequential):
                setattr(module, name, fuse_conv_bn_eval(*child))
    return network


def largest_difference(
    network: SegmentationNet,
    written: SegmentationNetwork,
    frames: LabelledFrames,
) -> float:
    """Compare the outputs of a network and of its file on the first frames, whole and cropped.

    Args:
        network: in evaluation mode.
        written: the file.
        frames: for the comparison.
    """
    found = 0.0
    for index in range(min(FRAMES_COMPARED_WITH_TORCH, len(frames))):
        picture = frames.example(index, None).features
        for size in (picture.shape[2], picture.shape[2] - SIDE_MULTIPLE):
            seen = np.ascontiguousarray(picture[..., :size])
            with torch.no_grad():
                expected = network(torch.from_numpy(seen)[None])[0].numpy()
            found = max(found, float(np.abs(expected - written(seen)).max()))
    return found


def _scores(
    network: SegmentationNetwork, frames: LabelledFrames, track: TrackProgress
) -> dict[str, float]:
    examples = [frames.example(index, None) for index in range(len(frames))]
    judged = (network(example.features) for example in examples)
    outputs = collected(judged, len(examples), "validation frames", track)
    return output_scores(np.stack(outputs), examples)
