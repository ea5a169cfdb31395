"""What candidate views would show of the leading hypotheses, and how much they would tell.

Each leading hypothesis, a thing in a pose, is rendered from each candidate camera with few pixels.
If one of them is true, the depth that is measured is its own, under the noise of the sensor, with
holes where the surface is seen at a grazing angle. ``verification.likelihood`` then judges this
depth given each other hypothesis; what it will say on average is computed here without drawing any
image. A view is worth the information that it is expected to give about the thing, or about thing
and pose (Denzler and Brown, "Information theoretic sensor data selection", IEEE TPAMI 2002).

Both directions of a difference count: a handle that only the rival has shows as surface that is
missing, and a handle that only the leading hypothesis has as surface that no rival explains.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

from nextview.errors import ObservationError
from nextview.geometry.observation import Observation
from nextview.geometry.viewsphere import azimuth_of, elevation_of, look_at_origin
from nextview.things.depth_view import THING, DepthView, depth_view
from nextview.things.registration import SCAN_ERROR, RegistrationPrior
from nextview.things.surface import SurfaceCaster
from nextview.things.verification import PixelModel
from nextview.things.verifier import Verified, Verifier
from nextview.things.weighing import EvidenceWeights

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]
Index = NDArray[np.int64]
Goal = Literal["thing", "pose"]

MOST_LEADING = 10  # hypotheses that are rendered
FEW_THINGS = 5  # likeliest things whose best hypothesis is always among them
LEAST_SHARE = 1e-4  # of the likeliest hypothesis' belief, below which one does not count
SENSOR_SIDE = 24  # rows and columns of a view by which the camera's noise is judged
RENDERED_SIDE = 18  # rows and columns of the rendered images
FITTED_EVERY = 3  # every so many pixels take part in the fit of one hypothesis to another
FITTED_REACH = 0.004  # metres of deviation at which a pixel of this fit counts half
GRAZING_COSINE = 0.3  # of incidence, below which holes become usual: see the cameras of simulation
LOWEST_COSINE = 0.15  # of incidence, in the judgement of a pixel
SURFACE_ERROR = 0.001  # metres by which a surface is off from its scan, in this fit
BHATTACHARYYA = 0.25  # of two equally wide Gaussians, as a share of their divergence
LARGEST_DEVIATION = 12.0  # standard deviations, beyond which a pixel is an outlier
TABLE_STEPS = 20  # entries of a table per standard deviation
SUPPORT_NEAR = 0.01  # metres from the height of the support, within which a point lies on it
OWN_MARGIN = 0.005  # metres around the thing, within which a point may be its own
OBSTACLE_REACH = 4.0  # radii of the thing, within which an obstacle may hide it
OBSTACLE_ROWS = 120  # rows of a depth image that are looked through for obstacles


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """The leading hypotheses: things in poses.

    Attributes:
        things: number of the surface of each, (H,) int64.
        poses: of the scan files' frames in the object frame, (H, 4, 4) float64, metres.
        belief: in each, (H,) float64, sums to 1.
    """

    things: Index
    poses: Float
    belief: Float

    @classmethod
    def leading(cls, verified: Verified, most: int = MOST_LEADING) -> "Hypotheses":
        """Choose the likeliest hypotheses, among them the best one of each likely thing.

        Args:
            verified: what the verifier found.
            most: how many at most.

        Returns:
            The hypotheses. The belief in a thing is shared among its hypotheses.
        """
        in_thing = np.bincount(
            verified.things, verified.probabilities, minlength=len(verified.belief)
        )
        share = verified.probabilities / np.maximum(in_thing[verified.things], 1e-300)
        belief = verified.belief[verified.things] * share

        first = np.unique(verified.things, return_index=True)[1]  # the best hypothesis of each
        first = first[np.argsort(-verified.belief[verified.things[first]], kind="stable")]
        ahead = np.zeros(len(belief))
        ahead[first[:FEW_THINGS]] = 1
        rows = np.argsort(-(ahead + belief), kind="stable")[:most]
        rows = rows[belief[rows] >= LEAST_SHARE * belief.max()]
        some = belief[rows]
        return cls(verified.things[rows], verified.poses[rows], some / some.sum())


@dataclass(frozen=True)
class ExpectedSensor:
    """The camera of the views to come.

    Attributes:
        pitch: angle between neighbouring pixels, radians.
        noise: standard deviation of the inverse depth, 1/metres.
    """

    pitch: float
    noise: float

    @classmethod
    def of(cls, views: Sequence[DepthView]) -> "ExpectedSensor":
        """The camera that took some views of the thing.

        Args:
            views: at least one.

        Raises:
            ObservationError: there is none.
        """
        if not views:
            raise ObservationError("without a view that shows the thing the sensor is not known")
        noise = []
        for view in views:
            thing = view.kind == THING
            noise.append(np.median(view.noise[thing] / view.depth[thing] ** 2))
        pitch = np.mean([view.pitch for view in views])
        return cls(float(pitch), float(np.mean(noise)))


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What is known of the scene around the thing.

    Attributes:
        obstacles: points of other things that may hide it, (N, 3) float64, object frame, metres.
        floor: height of the support, metres; minus infinity for none.
        reach: how far from the origin the support was seen, metres. There it is measured behind the
            thing; elsewhere nothing is.
    """

    obstacles: Float
    floor: float = -np.inf
    reach: float = 0.0

    @classmethod
    def nothing(cls) -> "Surroundings":
        """The thing alone, with nothing that is measured behind it."""
        return cls(np.zeros((0, 3)))

    @classmethod
    def of(
        cls, observations: Sequence[Observation], caster: SurfaceCaster, hypotheses: Hypotheses
    ) -> "Surroundings":
        """Gather what some views saw beside the thing.

        Args:
            observations: views of the thing, with all that their cameras saw. Those without that
                say nothing.
            caster: the surfaces.
            hypotheses: the leading ones. The support is where the first of them stands.

        Returns:
            Obstacles and the support.
        """
        surface = caster.surfaces[hypotheses.things[0]]
        pose = hypotheses.poses[0]
        floor = float((surface.vertices @ pose[2, :3] + pose[2, 3]).min())
        radius = surface.radius

        seen = [_beside(observation) for observation in observations]
        points = np.concatenate([np.zeros((0, 3)), *seen])
        height = points[:, 2] - floor
        away = np.linalg.norm(points[:, :2], axis=1)
        on_support = np.abs(height) < SUPPORT_NEAR
        reach = float(np.quantile(away[on_support], 0.95)) if on_support.any() else 0.0

        in_file = (points - pose[:3, 3]) @ pose[:3, :3]
        low = surface.vertices.min(0) - OWN_MARGIN
        high = surface.vertices.max(0) + OWN_MARGIN
        own = ((in_file > low) & (in_file < high)).all(1)
        near = np.linalg.norm(points, axis=1) < OBSTACLE_REACH * radius
        obstacles = points[(height > SUPPORT_NEAR) & near & ~own]
        return cls(obstacles, floor, reach)


def _beside(observation: Observation) -> Float:
    """Points that a view measured beside the thing, (N, 3), object frame, metres."""
    scene = observation.scene
    if scene is None or observation.radius is None:
        return np.zeros((0, 3))
    every = max(1, scene.depth.shape[0] // OBSTACLE_ROWS)
    depth = scene.depth[::every, ::every].astype(np.float64) * observation.radius
    target = scene.target[::every, ::every]
    rows, columns = np.nonzero((depth > 0) & np.isfinite(depth) & ~target)
    pixels = np.stack([columns * every + 0.5, rows * every + 0.5, np.ones(len(rows))])
    rays = np.linalg.inv(scene.intrinsics) @ pixels
    in_camera = (rays * depth[rows, columns]).T
    return in_camera @ scene.pose[:3, :3].T + scene.pose[:3, 3] * observation.radius


@dataclass(frozen=True, eq=False)
class ExpectedViews:
    """What candidate views are expected to tell.

    Attributes:
        hypotheses: what was rendered.
        divergence: expected log-likelihood ratio of two hypotheses after each view if one of them
            is true, the mean of both directions, (V, H, H) float64, 0 or more.
        different: share of the pixels that show either of two hypotheses in which they differ by
            more than the noise, (V, H, H) float64.
    """

    hypotheses: Hypotheses
    divergence: Float
    different: Float

    def information(self, goal: Goal = "thing") -> Float:
        """Expected information of each view, (V,) float64, natural units (nats).

        The expected entropy of the belief after a view is that of a mixture of Gaussians, which is
        bounded by the distances of Bhattacharyya between its parts (Kolchinsky and Tracey,
        "Estimating mixture entropy with pairwise distances", Entropy 2017).

        Args:
            goal: "thing" values what is told of which thing it is; "pose" what is told of thing and
                pose.
        """
        belief = self.hypotheses.belief
        possible = np.flatnonzero(belief)
        gains = np.stack([self.gain(int(row), goal) for row in possible], 1)
        return np.maximum(gains @ belief[possible], 0)

    def gain(self, truth: int, goal: Goal = "thing") -> Float:
        """Gain of the log-belief in the right answer with each view, (V,) float64.

        Args:
            truth: which hypothesis is true; the belief in it is not zero.
            goal: whether the answer is a thing, or a thing and its pose.
        """
        belief = self.hypotheses.belief
        kept = belief * np.exp(-BHATTACHARYYA * self.divergence[:, truth])
        same = np.arange(len(belief)) == truth
        if goal == "thing":
            same = self.hypotheses.things == self.hypotheses.things[truth]
        return np.log((kept[:, same].sum(1) / kept.sum(1)) / belief[same].sum())

    def entropy(self, goal: Goal = "thing") -> float:
        """Entropy of the present belief, nats: the most that a view can tell."""
        belief = self.hypotheses.belief
        if goal == "thing":
            belief = np.bincount(self.hypotheses.things, belief).astype(np.float64)
        some = belief[belief > 0]
        return float(-(some * np.log(some)).sum())

    def told_apart(self, view: int) -> tuple[int, int] | None:
        """The two hypotheses of different things that a view is expected to tell apart most.

        Returns:
            Their rows, the likelier one first; None if there is only one thing.
        """
        belief = self.hypotheses.belief
        things = self.hypotheses.things
        kept = np.exp(-BHATTACHARYYA * self.divergence[view])
        worth = belief[:, None] * belief * (1 - kept)
        worth[things[:, None] == things] = -1
        first, second = np.unravel_index(worth.argmax(), worth.shape)
        if worth[first, second] < 0:
            return None
        pair = (int(first), int(second))
        return pair if belief[first] >= belief[second] else pair[::-1]

    def words(self, view: int, names: Sequence[str], goal: Goal = "thing") -> str:
        """What a view is expected to settle, as a phrase.

        Args:
            view: which candidate.
            names: of the things.
            goal: what is to be told.
        """
        entropy = self.entropy(goal)
        share = min(1.0, float(self.information(goal)[view]) / entropy) if entropy > 0 else 0.0
        verb = "would settle" if share >= 0.5 else "would tell little of"
        doubt = f"{100 * share:.0f} % of the doubt"
        pair = self.told_apart(view)
        if goal == "pose":
            return f"{verb} the pose of {names[self.hypotheses.things[0]]}: {doubt}"
        if pair is None or entropy == 0:
            return f"there is no rival of {names[self.hypotheses.things[0]]}"

        first, second = (names[self.hypotheses.things[row]] for row in pair)
        differs = f"they differ in {100 * self.different[view][pair]:.0f} % of the pixels"
        return f"{verb} {first} or {second}: {differs}, {doubt}"


def expected_views(
    caster: SurfaceCaster,
    hypotheses: Hypotheses,
    cameras: Float,
    sensor: ExpectedSensor,
    surroundings: Surroundings | None = None,
    taken: int = 1,
    weights: EvidenceWeights = EvidenceWeights(),
    pixels: PixelModel = PixelModel(),
    prior: RegistrationPrior = RegistrationPrior(),
    side: int = RENDERED_SIDE,
) -> ExpectedViews:
    """Expect what candidate views would tell, with the verifier's own weights.

    Args:
        caster: the surfaces.
        hypotheses: the leading hypotheses.
        cameras: candidate camera poses, camera-to-world, (V, 4, 4), object frame, metres, OpenCV
            axes.
        sensor: the camera.
        surroundings: what may stand before the thing and behind it; nothing by default.
        taken: how many views there are already. More views count less each, see
            ``EvidenceWeights.correlation``.
        weights: how much geometry counts.
        pixels: how a pixel is judged.
        prior: by how much a hypothesis and a camera may still be moved when the view is there.
        side: rows and columns of the rendered images.

    Returns:
        What each view would tell of each pair of hypotheses.
    """
    cameras = np.asarray(cameras, np.float64)
    scene = Surroundings.nothing() if surroundings is None else surroundings
    rendered = _rendered(caster, hypotheses, cameras, scene, side)
    weight = weights.geometry / (1 + weights.correlation * taken)
    moved = _fitted(rendered, sensor, prior)
    divergence, different = _divergence(rendered, moved, sensor, pixels, prior)
    return ExpectedViews(hypotheses, weight * divergence, different)


@dataclass(frozen=True, eq=False)
class Outlook:
    """All that is known when the next view of a thing is to be chosen.

    Attributes:
        caster: the surfaces.
        hypotheses: the leading hypotheses.
        sensor: the camera.
        surroundings: what is known of the scene.
        place: of the last camera, (3,) float64, object frame, metres.
        taken: how many views there are.
        weights: how much geometry counts.
        pixels: how a pixel is judged.
        prior: by how much a hypothesis and a camera may still be moved.
    """

    caster: SurfaceCaster
    hypotheses: Hypotheses
    sensor: ExpectedSensor
    surroundings: Surroundings
    place: Float
    taken: int
    weights: EvidenceWeights
    pixels: PixelModel
    prior: RegistrationPrior

    @classmethod
    def of(
        cls, verifier: Verifier, verified: Verified, observations: Sequence[Observation]
    ) -> "Outlook":
        """Gather what some views have shown.

        Args:
            verifier: of the surfaces.
            verified: what it found in the views.
            observations: the views, the last one last; those that do not show the thing are left
                out.

        Raises:
            ObservationError: no view shows the thing, or its scale is not known.
        """
        found = ((each, depth_view(each, SENSOR_SIDE)) for each in observations if each.seen)
        seen = [(each, view) for each, view in found if view is not None]
        sensor = ExpectedSensor.of([view for _, view in seen])
        hypotheses = Hypotheses.leading(verified)
        used = [each for each, _ in seen]
        return cls(
            caster=verifier.caster,
            hypotheses=hypotheses,
            sensor=sensor,
            surroundings=Surroundings.of(used, verifier.caster, hypotheses),
            place=seen[-1][1].origin,
            taken=len(used),
            weights=verifier.weights,
            pixels=verifier.pixels,
            prior=verifier.prior,
        )

    @property
    def distance(self) -> float:
        """Of the last camera from the origin of the object frame, metres."""
        return float(np.linalg.norm(self.place))

    @property
    def towards(self) -> Float:
        """Unit vector from the origin of the object frame towards the last camera, (3,)."""
        return self.place / self.distance

    def cameras(self, directions: Float) -> Float:
        """Level cameras in some directions, as far away as the last one.

        Args:
            directions: unit vectors from the object, (V, 3).

        Returns:
            Camera-to-world poses, (V, 4, 4) float64, object frame, metres.
        """
        return look_at_origin(elevation_of(directions), azimuth_of(directions), self.distance)

    def expect(self, cameras: Float) -> ExpectedViews:
        """Expect what views from some cameras would tell.

        Args:
            cameras: camera-to-world poses, (V, 4, 4), object frame, metres.
        """
        return expected_views(
            self.caster,
            self.hypotheses,
            cameras,
            self.sensor,
            self.surroundings,
            self.taken,
            self.weights,
            self.pixels,
            self.prior,
        )


@dataclass(frozen=True, eq=False)
class _Images:
    """The hypotheses as V cameras would see them, P pixels each.

    Attributes:
        rays: through the pixels, as long as one metre of depth, (V, P, 3) float32.
        lengths: of these, (V, P) float32.
        depth: of each hypothesis, (V, H, P) float32, metres; infinity where it does not show, or
            something stands before it.
        hidden: where a hypothesis is behind something else, (V, H, P) bool.
        normals: towards the camera, (V, H, P, 3) float32, object frame.
        cosine: of the angle of incidence, (V, H, P) float32.
        behind: whether something is measured where no hypothesis shows, (V, P) bool.
        origins: of the cameras, (V, 3) float32.
        centre: about which hypotheses turn, (3,) float32.
        step: between pixels, tangents, (V, 2) float32, rows and columns.
        side: rows and columns.
    """

    rays: Float32
    lengths: Float32
    depth: Float32
    hidden: NDArray[np.bool_]
    normals: Float32
    cosine: Float32
    behind: NDArray[np.bool_]
    origins: Float32
    centre: Float32
    step: Float32
    side: int


def _rendered(
    caster: SurfaceCaster,
    hypotheses: Hypotheses,
    cameras: Float,
    scene: Surroundings,
    side: int,
) -> _Images:
    """Cast the rays of all cameras at all hypotheses in one call."""
    things = hypotheses.things
    turns = hypotheses.poses[:, :3, :3].astype(np.float32)
    places = hypotheses.poses[:, :3, 3]
    origins = cameras[:, :3, 3]
    x, y, step = _windows(caster, hypotheses, cameras, side)

    views = len(cameras)
    count = len(things)
    in_camera = np.ones((views, side, side, 3))
    in_camera[..., 0] = x[:, None, :]
    in_camera[..., 1] = y[:, :, None]
    turned = in_camera.reshape(views, -1, 3) @ cameras[:, :3, :3].swapaxes(1, 2)
    rays = turned.astype(np.float32)

    # Rows of the call: all hypotheses of the first camera, then of the second.
    from_place = origins[:, None] - places
    in_file = np.einsum("vhj,hji->vhi", from_place, hypotheses.poses[:, :3, :3])
    directions = rays[:, None] @ turns
    depth, normals = caster.cast(
        np.tile(things, views),
        in_file.reshape(-1, 3).astype(np.float32),
        directions.reshape(views * count, -1, 3),
    )
    depth = depth.reshape(views, count, -1)
    normals = normals.reshape(views, count, -1, 3)
    lengths = np.sqrt(np.einsum("vpi,vpi->vp", rays, rays))
    cosine = -np.einsum("vhpi,vhpi->vhp", normals, directions) / lengths[:, None]

    before = _obstacle_depth(scene.obstacles, cameras, x, y, step)
    hidden = np.isfinite(depth) & (depth > before[:, None])
    behind = np.isfinite(before) | _support_shows(scene, origins, rays)
    centre = np.mean(np.einsum("hij,hj->hi", turns, caster.centres[things]) + places, axis=0)
    return _Images(
        rays=rays,
        lengths=lengths.astype(np.float32),
        depth=np.where(hidden, np.float32(np.inf), depth),
        hidden=hidden,
        normals=normals @ turns.swapaxes(1, 2),
        cosine=np.clip(cosine, LOWEST_COSINE, 1).astype(np.float32),
        behind=behind,
        origins=origins.astype(np.float32),
        centre=centre.astype(np.float32),
        step=step.astype(np.float32),
        side=side,
    )


def _windows(
    caster: SurfaceCaster, hypotheses: Hypotheses, cameras: Float, side: int
) -> tuple[Float, Float, Float]:
    """Tangents of columns and rows, (V, side) each, that cover all hypotheses, and the steps."""
    boxes = []
    for thing, pose in zip(hypotheses.things, hypotheses.poses, strict=True):
        vertices = caster.surfaces[thing].vertices
        ends = np.stack([vertices.min(0), vertices.max(0)])
        corners = np.stack(np.meshgrid(*ends.T), -1).reshape(-1, 3)
        boxes.append(corners @ pose[:3, :3].T + pose[:3, 3])
    corners = np.concatenate(boxes)

    in_camera = (corners - cameras[:, None, :3, 3]) @ cameras[:, :3, :3]
    ahead = np.maximum(in_camera[..., 2:], 1e-3)
    tangents = in_camera[..., :2] / ahead
    low = tangents.min(1)
    step = (tangents.max(1) - low) / side
    middles = np.arange(side) + 0.5
    x = low[:, :1] + step[:, :1] * middles
    y = low[:, 1:] + step[:, 1:] * middles
    return x, y, step[:, ::-1]


def _obstacle_depth(obstacles: Float, cameras: Float, x: Float, y: Float, step: Float) -> Float32:
    """Depth of the nearest obstacle at each pixel, (V, P) float32; infinity where there is none."""
    views, side = x.shape
    depth = np.full((views, side, side), np.inf, np.float32)
    if not len(obstacles):
        return depth.reshape(views, -1)

    in_camera = (obstacles - cameras[:, None, :3, 3]) @ cameras[:, :3, :3]
    z = in_camera[..., 2]
    ahead = np.maximum(z, 1e-3)
    column = np.floor((in_camera[..., 0] / ahead - x[:, :1]) / step[:, 1:] + 0.5).astype(np.int64)
    row = np.floor((in_camera[..., 1] / ahead - y[:, :1]) / step[:, :1] + 0.5).astype(np.int64)
    inside = (z > 1e-3) & (row >= 0) & (row < side) & (column >= 0) & (column < side)
    view, point = np.nonzero(inside)
    at = (view, row[view, point], column[view, point])
    np.minimum.at(depth, at, z[view, point].astype(np.float32))
    # Points may lie farther apart than pixels: gaps between them are closed.
    wider = minimum_filter(depth, (1, 3, 3))
    return maximum_filter(wider, (1, 3, 3)).reshape(views, -1)


def _support_shows(scene: Surroundings, origins: Float, rays: Float32) -> NDArray[np.bool_]:
    """Where the support was seen behind the thing, (V, P) bool."""
    if not np.isfinite(scene.floor) or scene.reach == 0:
        return np.zeros(rays.shape[:2], bool)
    height = origins[:, 2] - scene.floor
    down = -rays[..., 2]
    along = height[:, None] / np.where(down > 0, down, np.inf)
    there = origins[:, None, :2] + along[..., None] * rays[..., :2]
    away = np.linalg.norm(there, axis=2)
    return (down > 0) & (height[:, None] > 0) & (away < scene.reach)


def _displaced(images: _Images, prior: RegistrationPrior) -> Float:
    """By how much each camera may see the thing displaced along each axis, (V,), metres.

    As ``RegistrationPrior.displaced`` says of views that were taken.
    """
    away = np.linalg.norm(images.origins - images.centre, axis=1).astype(np.float64)
    return np.hypot(prior.camera, prior.aim * away)


def _pairs(count: int) -> tuple[Index, Index]:
    """Rows of all pairs of hypotheses, each once."""
    first, second = np.triu_indices(count, 1)
    return first, second


def _depth_variance(images: _Images, sensor: ExpectedSensor, pixels: PixelModel) -> Float32:
    """Variance of the depth that is measured of each hypothesis, (V, H, P) float32, metres^2."""
    depth = np.where(np.isfinite(images.depth), images.depth, 1)
    steepness = np.sqrt(1 - images.cosine**2) / images.cosine
    noise = sensor.noise * depth**2
    sideways = pixels.steep * sensor.pitch * depth * steepness
    return (noise**2 + SCAN_ERROR**2 + sideways**2).astype(np.float32)


def _fitted(images: _Images, sensor: ExpectedSensor, prior: RegistrationPrior) -> Float32:
    """Difference in depth of each pair that is left once one is aligned with the other.

    When the view is there, all hypotheses are aligned anew, and each camera may be displaced. What
    a small motion takes away tells nothing. One Gauss-Newton step, held near zero by the prior, is
    what registration would do.

    Returns:
        (V, pairs, P) float32, metres; 0 where not both show.
    """
    first, second = _pairs(images.depth.shape[1])
    depth_a = images.depth[:, first]
    depth_b = images.depth[:, second]
    both = np.isfinite(depth_a) & np.isfinite(depth_b)
    a = np.where(both, depth_a, 0)
    gap = a - np.where(both, depth_b, 0)
    if not len(first):
        return gap

    # A symmetric Jacobian: the surface halfway between the two.
    axes = [images.normals[..., k] for k in range(3)]
    normals = [axis[:, first] + axis[:, second] for axis in axes]
    scale = both / np.sqrt(normals[0] ** 2 + normals[1] ** 2 + normals[2] ** 2 + 1e-12)
    normals = [axis * scale for axis in normals]
    middle = a - gap / 2
    start = images.origins - images.centre
    rays = [images.rays[..., k] for k in range(3)]
    arms = [start[:, k, None, None] + rays[k][:, None] * middle for k in range(3)]
    columns = [
        arms[1] * normals[2] - arms[2] * normals[1],
        arms[2] * normals[0] - arms[0] * normals[2],
        arms[0] * normals[1] - arms[1] * normals[0],
        *normals,
    ]
    steepest = -LOWEST_COSINE * images.lengths[:, None]
    along = np.minimum(sum(normals[k] * rays[k][:, None] for k in range(3)), steepest)

    some = slice(None, None, FITTED_EVERY)
    distance = (gap * along)[..., some]
    noise = sensor.noise * middle[..., some] ** 2
    weights = both[..., some] / (SURFACE_ERROR**2 + noise**2)
    weights = weights / (1 + (distance / FITTED_REACH) ** 2)
    used = np.maximum(both[..., some].sum(2, keepdims=True), 1)
    weights = (weights * np.minimum(1, prior.pixels / used)).astype(np.float32)
    thinned = np.stack([column[..., some] for column in columns], 2)
    weighted = thinned * weights[:, :, None]
    held = np.zeros((len(images.origins), 1, 6))
    held[..., :3] = 1 / prior.tilt**2
    held[..., 3:] = 1 / _displaced(images, prior)[:, None, None] ** 2
    left = (weighted @ thinned.swapaxes(2, 3)).astype(np.float64)
    left += held[..., None] * np.eye(6)
    right = (weighted @ distance[..., None]).astype(np.float64)
    motion = np.linalg.solve(left, right)[..., 0].astype(np.float32)

    taken_away = sum(columns[k] * motion[:, :, k, None] for k in range(6)) / along
    return np.where(both, gap - taken_away, 0).astype(np.float32)


def _divergence(
    images: _Images,
    gaps: Float32,
    sensor: ExpectedSensor,
    pixels: PixelModel,
    prior: RegistrationPrior,
) -> tuple[Float, Float]:
    """Expected difference of two hypotheses' mean log-likelihood, and of their pixels.

    Returns:
        Mean of both directions, (V, H, H), and the share of their pixels that differ, (V, H, H).
    """
    views, count = images.depth.shape[:2]
    first, second = _pairs(count)
    divergence = np.zeros((views, count, count))
    different = np.zeros((views, count, count))
    if not len(first):
        return divergence, different

    judged = _Judged.of(images, sensor, pixels, prior)
    forth = judged.ratio(first, second, gaps)
    back = judged.ratio(second, first, gaps)
    both_ways = np.maximum((forth + back) / 2, 0)
    share = judged.different(first, second, gaps)
    for rows, columns in ((first, second), (second, first)):
        divergence[:, rows, columns] = both_ways
        different[:, rows, columns] = share
    return divergence, different


@dataclass(frozen=True, eq=False)
class _Judged:
    """What the judgement of pixels rests on, (V, H, P) each if not said otherwise.

    Attributes:
        shows: where a hypothesis shows, bool.
        lost: chance that nothing is measured there.
        deviation: standard deviation of the depth there, metres.
        hole: log-likelihood of a hole there.
        missing: log-likelihood of a pixel of the thing that shows nothing of another hypothesis.
        apart: how surely a pixel beside a hypothesis is beside it after it is aligned anew, 0 to
            1.
        behind: whether something is measured where a hypothesis does not show, (V, 1, P).
        area: pixels of the camera in one of these, (V, 1).
        enough: pixels of the camera from which on a view counts in full.
        matches: expected log-likelihood of a depth by its deviation, see ``_match_table``.
    """

    shows: NDArray[np.bool_]
    lost: Float32
    deviation: Float32
    hole: Float32
    missing: Float32
    apart: Float32
    behind: NDArray[np.bool_]
    area: Float
    enough: float
    outlier: float
    matches: Float32

    @classmethod
    def of(
        cls,
        images: _Images,
        sensor: ExpectedSensor,
        pixels: PixelModel,
        prior: RegistrationPrior,
    ) -> "_Judged":
        shows = np.isfinite(images.depth)
        size = images.step / sensor.pitch  # of a pixel here, pixels of the camera
        within, beside = _rings(shows, images.side)
        deep = np.clip(within * size.mean(1)[:, None, None] / pixels.edge, 0.1, 1)

        away = np.linalg.norm(images.origins - images.centre, axis=1)
        metres = images.step.mean(1) * away
        displaced = _displaced(images, prior).astype(np.float32)
        beside = beside * (metres / displaced)[:, None, None]
        return cls(
            shows=shows,
            lost=np.where(shows, np.maximum(1 - images.cosine / GRAZING_COSINE, 0), 0),
            deviation=np.sqrt(_depth_variance(images, sensor, pixels)),
            hole=(pixels.hole * images.cosine).astype(np.float32),
            missing=(pixels.outlier * deep).astype(np.float32),
            apart=1 - np.exp(-0.5 * beside**2),
            behind=images.behind[:, None],
            area=size.prod(1)[:, None].astype(np.float64),
            enough=prior.pixels,
            outlier=pixels.outlier,
            matches=_match_table(pixels.outlier),
        )

    def ratio(self, true: Index, other: Index, gaps: Float32) -> Float:
        """Expected mean log-likelihood of the true hypotheses less that of the others, (V, K)."""
        shows = self.shows[:, true]
        rival = self.shows[:, other]
        lost = self.lost[:, true]
        kept = shows * (1 - lost)

        # Where both show.
        off = np.abs(gaps) / self.deviation[:, other] * TABLE_STEPS
        match = self.matches[np.minimum(off, len(self.matches) - 1).astype(np.int32)]
        hole = self.hole[:, other]
        judged = np.where(rival, kept * match + lost * hole, 0)
        # Where only the true one shows: surface that the other one does not explain.
        alone = shows & ~rival
        judged += np.where(alone, kept * self.missing[:, true] * self.apart[:, other], 0)
        # Where only the other one shows: what is behind is seen through it, or nothing is measured.
        through = rival & ~shows
        seen_through = self.outlier * self.apart[:, true]
        judged += np.where(through, np.where(self.behind, seen_through, hole), 0)
        counted = (kept + np.where(rival, lost, 0) + through).sum(2)

        best = kept * self.matches[0] + lost * self.hole[:, true]
        own = shows.sum(2)
        mean = judged.sum(2) / np.maximum(counted, 1) - best.sum(2) / np.maximum(own, 1)
        union = (shows | rival).sum(2)
        return -mean.astype(np.float64) * np.minimum(1, union * self.area / self.enough)

    def different(self, first: Index, second: Index, gaps: Float32) -> Float:
        """Share of the pixels of either hypothesis in which they differ, (V, K)."""
        shows = self.shows[:, first]
        rival = self.shows[:, second]
        off = np.abs(gaps) > 3 * self.deviation[:, second]
        alone = np.where(shows, self.apart[:, second], self.apart[:, first]) > 0.5
        differ = np.where(shows & rival, off, (shows ^ rival) & alone)
        return differ.sum(2) / np.maximum((shows | rival).sum(2), 1)


@lru_cache(maxsize=4)
def _match_table(outlier: float) -> Float32:
    """Expected log-likelihood of a depth by its deviation from the surface, standard deviations.

    The expectation of ``verification.likelihood``'s mixture over Gaussian noise, by Gauss-Hermite
    quadrature; one entry for every 1 / TABLE_STEPS.
    """
    nodes, shares = np.polynomial.hermite_e.hermegauss(40)
    deviations = np.arange(int(LARGEST_DEVIATION * TABLE_STEPS) + 1) / TABLE_STEPS
    squared = (deviations[:, None] + nodes) ** 2
    match = np.log(np.exp(-squared / 2) + np.exp(outlier)) - np.log1p(np.exp(outlier))
    return (match @ shares / shares.sum()).astype(np.float32)


def _rings(shows: NDArray[np.bool_], side: int) -> tuple[Float32, Float32]:
    """Distance to the outline within it, and beside it, (V, H, P) each, pixels; at most 2.5."""
    image = shows.reshape(*shows.shape[:2], side, side)
    within = np.full(image.shape, 0.5, np.float32)
    beside = np.full(image.shape, 0.5, np.float32)
    inner = image
    outer = image
    for _ in range(2):
        inner = inner & _neighbours(inner).all(0)
        outer = outer | _neighbours(outer).any(0)
        within += inner
        beside += ~outer
    return within.reshape(shows.shape), beside.reshape(shows.shape)


def _neighbours(image: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The four neighbours of each pixel of images, (4, V, H, rows, columns)."""
    padded = np.pad(image, ((0, 0), (0, 0), (1, 1), (1, 1)))
    up = padded[..., :-2, 1:-1]
    down = padded[..., 2:, 1:-1]
    left = padded[..., 1:-1, :-2]
    right = padded[..., 1:-1, 2:]
    return np.stack([up, down, left, right])
