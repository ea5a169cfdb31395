"""Monty of the Thousand Brains Project on YCB scans in random 3D rotations.

    python research/peers/monty.py scans YCB WORK
    python research/peers/monty.py teach WORK distinct      # or similar
    python research/peers/monty.py recognise WORK distinct
    python -m research.peers.beside_monty YCB WORK          # nextview, in an environment of its own

Monty needs an environment of its own, in which nextview need not be installed:

    pip install --no-deps tbp.monty==0.55.0
    pip install mujoco==3.3.7 "numpy<2" hydra-core pydantic numpy-quaternion torch torch-geometric \
        scipy pandas scikit-learn scikit-image matplotlib pillow sympy tqdm importlib_resources \
        trimesh tyro

and OSMesa, Mesa's renderer without a screen (Debian: libosmesa6), with MUJOCO_GL=osmesa. The scans
are written as its simulator reads them, under its own names, in metres, with the y axis up and one
grey: Monty's feature of colour tells nothing. Its own configurations are used, for its own lists of
ten distinct and ten similar things: it is taught by the surface agent
(``only_surf_agent_training_10obj_mujoco``, ``..._10simobj_...``) and tested with the distant agent
and noise (``randrot_noise_10distinctobj_dist_agent_mujoco``, ``..._10simobj_...``). Changed are how
many rotations are taught (some of its fourteen: the faces of a cube, opposite ones first) and
tested, and shadows and smoothed edges, which the renderer draws slowly and no depth shows.

Each rotation of the ten things is a lesson, and one of the test: ``teach`` and ``recognise`` go on
after the last complete one.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from tyro.extras import subcommand_cli_from_dict

THINGS = {
    "distinct": (
        "mug",
        "bowl",
        "potted_meat_can",
        "spoon",
        "strawberry",
        "mustard_bottle",
        "dice",
        "golf_ball",
        "c_lego_duplo",
        "banana",
    ),
    "similar": (
        "mug",
        "e_cups",
        "knife",
        "fork",
        "spoon",
        "c_cups",
        "d_cups",
        "cracker_box",
        "sugar_box",
        "pudding_box",
    ),
}
"""Monty's own lists, in its order."""

LESSONS = {
    "distinct": "only_surf_agent_training_10obj_mujoco",
    "similar": "only_surf_agent_training_10simobj_mujoco",
}
TESTS = {
    "distinct": "randrot_noise_10distinctobj_dist_agent_mujoco",
    "similar": "randrot_noise_10simobj_dist_agent_mujoco",
}
ROTATIONS = ((0, 0, 0), (0, 180, 0), (90, 0, 0), (90, 180, 0), (0, 90, 0), (0, 270, 0))
"""In which the things are taught, degrees: those of Monty's that show the faces of a cube."""

Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
Things = Literal["distinct", "similar"]
TAUGHT = "taught"  # folders below WORK
TESTED = "tested"
MODEL = "model.pt"
SEED = 42  # Monty's own
EPISODES = "eval_stats.csv"  # what Monty writes of its episodes
OBJECTS = "mujoco/objects/ycb"  # where Monty's simulator looks for things


def scans(folder: tyro.conf.Positional[Path], work: tyro.conf.Positional[Path]) -> None:
    """Write the scans as Monty's simulator reads them.

    Args:
        folder: of the scans, PLY, metres, z up.
        work: folder to write to.
    """
    import trimesh
    from PIL import Image

    names = sorted({*THINGS["distinct"], *THINGS["similar"]})
    for name in names:
        place = work / OBJECTS / name
        place.mkdir(parents=True, exist_ok=True)
        mesh = trimesh.load(folder / f"{name}.ply", process=False, force="mesh")
        mesh.apply_translation(-mesh.bounds.mean(0))
        mesh.apply_transform(Y_UP)
        plain = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        plain.export(place / "textured.obj", include_normals=False)
        Image.new("RGB", (4, 4), (128, 128, 128)).save(place / "texture_map.png")
    print(f"{len(names)} scans in {work / OBJECTS}")


def teach(
    work: tyro.conf.Positional[Path],
    things: tyro.conf.Positional[Things],
    rotations: int = 4,
) -> None:
    """Teach Monty ten things, in one rotation after the other; goes on where it was stopped.

    Args:
        work: folder that ``scans`` wrote.
        things: which ten.
        rotations: in how many each is taught, at most six.
    """
    before = ""
    for number, rotation in enumerate(ROTATIONS[:rotations]):
        place = work / TAUGHT / things / f"{number}"
        if not list(place.rglob(MODEL)):
            _run(
                work,
                LESSONS[things],
                "experiment.config.n_train_epochs=1",
                "experiment.config.train_env_interface_args.object_init_sampler.rotations="
                f"[{list(rotation)}]",
                f"experiment.config.model_name_or_path='{before}'",
                f"experiment.config.logging.output_dir={place.absolute()}",
            )
        before = str(next(place.rglob(MODEL)).parent.absolute())


def recognise(
    work: tyro.conf.Positional[Path],
    things: tyro.conf.Positional[Things],
    rotations: int = 3,
) -> None:
    """Show Monty ten things in random rotations; goes on where it was stopped.

    Args:
        work: folder that ``scans`` wrote.
        things: which ten.
        rotations: how many of each thing; Monty's seed draws them, another one for each episode.
    """
    taught = sorted((work / TAUGHT / things).rglob(MODEL))
    if not taught:
        raise SystemExit(f"{work}: nothing was taught; run the stage teach first")
    print(f"each thing was taught in {len(taught)} of Monty's fourteen rotations")
    for number in range(rotations):
        place = work / TESTED / things / f"{number}"
        if not list(place.rglob(EPISODES)):
            _run(
                work,
                TESTS[things],
                "logging=basic_warning_monty_runs",
                f"experiment.config.seed={SEED + number}",
                "experiment.config.n_eval_epochs=1",
                f"experiment.config.model_name_or_path={taught[-1].parent.absolute()}",
                f"experiment.config.logging.output_dir={place.absolute()}",
                "experiment.config.python_log_level=WARNING",
            )


def _run(work: Path, experiment: str, *changes: str) -> None:
    """Run one of Monty's experiments with some changes, and say how long it took."""
    for name in ("MONTY_DATA", "MONTY_MODELS", "MONTY_LOGS"):
        os.environ[name] = str(work.absolute())
    import hydra
    from tbp.monty.hydra import instantiate_experiment
    from tbp.monty.simulators.mujoco import MuJoCoSimulator

    usual = MuJoCoSimulator._configure_spec_settings

    def drawn_plainly(simulator: Any) -> None:
        usual(simulator)
        simulator.spec.visual.quality.shadowsize = 0
        simulator.spec.visual.quality.offsamples = 0

    MuJoCoSimulator._configure_spec_settings = drawn_plainly
    with hydra.initialize_config_module("tbp.monty.conf", version_base=None):
        config = hydra.compose("experiment", [f"experiment={experiment}", *changes])

    start = time.perf_counter()
    begun = time.process_time()
    with instantiate_experiment(config.experiment) as made:
        made.run()
    seconds = time.perf_counter() - start
    print(f"{experiment}: {seconds:.0f} s, {time.process_time() - begun:.0f} s of CPU")


def main() -> None:
    """Run one of the stages."""
    subcommand_cli_from_dict({"scans": scans, "teach": teach, "recognise": recognise})


if __name__ == "__main__":
    main()
