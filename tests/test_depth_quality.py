"""What ``nextview check`` tells of the depth, on frames of a plane whose errors are known."""

import numpy as np
import pytest
from factories import poses_around
from PIL import Image
from programs import main

from nextview.captured.depth_quality import depth_quality
from nextview.geometry.pinhole import pinhole_matrix
from nextview.sensing.frame import Frame

HEIGHT, WIDTH, FOCAL = 240, 320, 300.0
MATRIX = pinhole_matrix(FOCAL, FOCAL, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
NOISE = 0.002  # metres at 1 m, grows with the square of the depth
STANDS = ((0.5, 65), (0.6, 40), (0.7, 55), (0.85, 45), (1.0, 60), (1.1, 50), (1.2, 70))


def plane_frame(distance, elevation, rng, scale=1.0):
    """A noisy frame of the plane z = 0, with a pose that is wrong by 1 mm."""
    (pose,) = poses_around(
        [rng.uniform(0, 6)], np.radians(elevation), distance, np.zeros(3)
    )
    rows, columns = np.indices((HEIGHT, WIDTH))
    rays = np.stack([columns, rows, np.ones((HEIGHT, WIDTH))], -1)
    rays = rays @ np.linalg.inv(MATRIX).T @ pose[:3, :3].T
    depth = pose[2, 3] / -rays[..., 2]
    measured = scale * (depth + NOISE * depth**2 * rng.normal(size=depth.shape))
    pose[:3, 3] += rng.normal(0, 0.001, 3)
    return Frame(np.where(depth > 0, measured, 0).astype(np.float32), MATRIX, pose)


def frames_of(stands, scale=1.0):
    rng = np.random.default_rng(4)
    return [plane_frame(*stand, rng, scale) for stand in stands]


def test_the_noise_is_that_of_the_frame():
    quality = depth_quality(frames_of([(0.8, 45)]))
    assert quality.noise == pytest.approx(NOISE * quality.depths**2, rel=0.15)
    assert quality.uneven < quality.noise[1]
    assert quality.scale is None
    # a thing of 1,000 pixels
    pixel = quality.depths / FOCAL
    assert quality.smallest() == pytest.approx(pixel * np.sqrt(1000))
    assert (quality.detail() >= 2 * pixel).all()


@pytest.mark.parametrize("scale", [0.97, 1.0, 1.04])
def test_the_scale_is_told_by_frames_from_several_distances(scale):
    found = depth_quality(frames_of(STANDS, scale)).scale
    assert abs(found.share - (scale - 1)) < 2 * found.uncertainty
    assert found.uncertainty < 0.015
    words = {0.97: "too short", 1.0: "is right within", 1.04: "too long"}
    assert words[scale] in str(found)


def test_it_is_not_told_from_one_distance():
    assert depth_quality(frames_of([(0.8, 45)] * 5, 1.04)).scale is None
    assert depth_quality(frames_of(STANDS, 1.04), still=False).scale is None


def test_check_says_so_and_draws_it(tmp_path, capsys):
    depth = np.rint(1000 * frames_of([(0.8, 45)])[0].depth).astype(np.uint16)
    Image.fromarray(depth).save(tmp_path / "depth.png")
    camera = [str(n) for n in (FOCAL, FOCAL, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)]
    picture = tmp_path / "picture.png"
    given = ["--intrinsics", *camera, "--depth-scale", "0.001"]
    main(["check", str(tmp_path / "depth.png"), *given, "--figure", str(picture)])
    said = capsys.readouterr().err
    assert said.count("most things get a name from") == 3
    assert "cannot be told" in said
    assert "contradict" not in said  # of one frame
    with Image.open(picture) as drawn:
        assert drawn.width > 500
