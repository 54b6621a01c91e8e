"""Every prior, and combinations of them, between two small views; all of it can be moved to another camera frame."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from modeler import se3
from modeler.priors import (
    AnyMotion,
    AnyTurn,
    AutoPrior,
    FeaturesPrior,
    GeneralPrior,
    HeldPrior,
    Poke,
    PokePrior,
    PredictedProposal,
    ProductPrior,
    TablePrior,
    TurntablePrior,
    VelocityPrior,
)
from modeler.types import (
    AbstractPoseDensity,
    AbstractPrior,
    Array,
    Camera,
    Edge,
    Frame,
    HandPoses,
    Outcome,
    Plane,
    PoseGaussian,
    Posterior,
    RayImage,
    Solution,
    Stated,
)

NORMAL = np.array([0.1, -0.8, -0.6]) / np.linalg.norm([0.1, -0.8, -0.6])
AXIS_POINT_M = np.array([0.02, 0.03, 0.82])
STEP = np.radians(24.0)


def view(index: int, points_m: Array, plane: Plane | None, normals: Array | None = None) -> RayImage:
    """A view with nothing but surface points and a support plane."""
    frame = Frame(index, 0.5 * index, np.ones((2, 2), dtype=np.float32), Camera(2, 2, 1.0, 1.0, 0.5, 0.5))
    normals = np.zeros_like(points_m) if normals is None else normals
    return RayImage(frame, plane, 0.002, 0.002, points_m, normals, np.zeros((len(points_m), 2), int))


def turned(angle_rad: float, axis: Array = NORMAL, point_m: Array = AXIS_POINT_M) -> Array:
    """The motion (4, 4) that turns about a line."""
    turn = se3.exp(np.concatenate([angle_rad * axis, np.zeros(3)]))
    return se3.translation(point_m) @ turn @ se3.translation(-point_m)


def surface(count: int = 3000) -> tuple[Array, Array]:
    """Points (n, 3) and normals (n, 3) of an oblong with a hump and a ridge, about the origin."""
    rng = np.random.default_rng(5)
    u, v = rng.uniform(-1, 1, (2, count))

    def height(u: Array, v: Array) -> Array:
        return -0.03 * (u**2 + v**2) + 0.03 * np.exp(-((u - 0.4) ** 2 + v**2) / 0.04) + 0.02 * (u + 0.5 * v > 0) * u * v

    def place(u: Array, v: Array) -> Array:
        return np.stack([0.09 * u, 0.035 * v, height(u, v)], axis=1).astype(np.float64)

    step = 1e-4
    normals = np.cross(place(u + step, v) - place(u - step, v), place(u, v + step) - place(u, v - step))
    return place(u, v), np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True), dtype=np.float64)


def views(camera: Array, *, table: bool = True) -> tuple[RayImage, RayImage]:
    """Source (frame 3) and target (frame 2) of an object that turns a step about the normal, seen from a camera."""
    points_m, normals = surface()
    stand = se3.translation(np.array([0.0, 0.0, 0.8])) @ se3.exp(np.array([2.2, 0.3, 0.1, 0, 0, 0]))
    normal = camera[:3, :3] @ NORMAL
    plane = Plane(normal, 0.7 - float(normal @ camera[:3, 3]), 0.004, 0.001) if table else None
    shown = []
    for index in (3, 2):
        pose = camera @ turned((index - 2) * STEP) @ stand
        shown.append(view(index, se3.transform(pose, points_m), plane, normals @ pose[:3, :3].T))
    return shown[0], shown[1]


def truth(camera: Array) -> Array:
    """target_from_source between the two views."""
    return camera @ turned(-STEP) @ se3.inverse(camera)


def solution(camera: Array, frames: int = 3) -> Solution:
    """Poses of frames 0 to frames - 1 of the turning object."""
    return Solution({k: se3.inverse(camera @ turned(k * STEP) @ se3.inverse(camera)) for k in range(frames)})


def edges(camera: Array, count: int = 5, noise: float = 1.0, seed: int = 0) -> tuple[Edge, ...]:
    """Accepted registrations of successive frames, a little off, with their covariances."""
    rng = np.random.default_rng(seed)
    sigma = noise * np.repeat([np.radians(0.3), 0.0005], 3)
    centre = se3.translation(np.array([0.0, 0.0, 0.8]))
    found = []
    for k in range(count):
        off = centre @ se3.exp(rng.normal(size=6) * sigma) @ se3.inverse(centre)
        to_camera = se3.adjoint(camera @ centre)
        pose = PoseGaussian(
            camera @ turned(-STEP) @ off @ se3.inverse(camera), to_camera @ np.diag(sigma**2) @ to_camera.T
        )
        found.append(
            Edge(
                Posterior(k + 1, k, pose, outcome=Outcome.CONVERGED, overlap=0.9),
                "odometry",
                accepted=True,
                reason=Stated(""),
            )
        )
    return tuple(found)


def hand(camera: Array) -> tuple[Array, Array]:
    """Times (n,) and poses (n, 4, 4) of a hand that turns with the object."""
    grip = se3.translation(np.array([0.03, 0.0, 0.75])) @ se3.exp(np.array([0.4, -0.2, 0.9, 0, 0, 0]))
    return np.arange(5.0) * 0.5, np.array([camera @ turned((k - 2) * STEP) @ grip for k in range(5)])


def stated(direction: Array) -> tuple[float, float, float]:
    """Three numbers as an option has them."""
    x, y, z = direction.tolist()
    return x, y, z


@dataclass(frozen=True)
class Case:
    """One prior to be held to the contract."""

    prior: Callable[[Array], AbstractPrior]
    """The prior, given the scene as the camera (4, 4, from the scene's own) sees it."""
    table: bool = True
    """Whether the views show their table."""
    proposes: bool = False
    """Whether some of the density only tells where to look."""
    shaken: float = 1e-5
    """Most that another camera frame changes in the log density, where cubes or draws depend on it."""

    def density(self, camera: Array | None = None) -> AbstractPoseDensity:
        """The density between the two views."""
        camera = np.eye(4) if camera is None else camera
        return self.prior(camera).between(*views(camera, table=self.table))


def turntable(camera: Array, **given: object) -> TurntablePrior:
    """A turntable whose axis is given in direction, and as the keywords say."""
    prior = TurntablePrior(24.0, 2.0, axis_direction=stated(camera[:3, :3] @ NORMAL))
    return replace(prior, **given)  # pyright: ignore[reportArgumentType]


def held(camera: Array) -> HeldPrior:
    """A hand."""
    return HeldPrior(HandPoses(*hand(camera)))


def poke(camera: Array) -> PokePrior:
    """A push that brings the object from the earlier view about to the later."""
    point_m = se3.transform(camera, np.array([[0.05, 0.02, 0.8]]))[0]
    return PokePrior(Poke(stated(point_m), stated(camera[:3, :3] @ np.array([0.2, 0.6, -0.8])), 0.03))


def velocity(camera: Array) -> AbstractPrior:
    """A pace learnt from three frames."""
    return VelocityPrior().learned(solution(camera), ())


def foreseen(camera: Array) -> AbstractPrior:
    """A motion on the table that the graph foretells, about right."""
    spread = se3.adjoint(camera) @ (0.02**2 * np.eye(6)) @ se3.adjoint(camera).T
    about_right = camera @ turned(-STEP) @ se3.exp(np.full(6, 0.01)) @ se3.inverse(camera)
    return PredictedProposal(TablePrior(), PoseGaussian(about_right, spread))


CASES: dict[str, Case] = {
    "general": Case(lambda _: GeneralPrior(max_rotation_deg=30, max_offset_m=0.03)),
    "any motion": Case(lambda _: AnyMotion()),
    "auto": Case(lambda _: AutoPrior(GeneralPrior(30, 0.03), TablePrior(40, 0.03))),
    "auto, no table": Case(lambda _: AutoPrior(), table=False),
    "any turn on a table": Case(lambda _: AnyTurn()),
    "table": Case(lambda _: TablePrior(max_rotation_deg=40, max_shift_m=0.03)),
    "turntable": Case(turntable),
    "turntable on its table": Case(lambda _: TurntablePrior(24.0, 2.0, needs_table=True)),
    "turntable either way": Case(lambda camera: turntable(camera, step_sign="unknown")),
    "turntable at a point": Case(
        lambda camera: turntable(camera, axis_point_m=stated(se3.transform(camera, AXIS_POINT_M[None])[0]))
    ),
    "turntable of rough axis": Case(lambda camera: turntable(camera, axis_sigma_deg=30.0), table=False),
    "turntable of any axis": Case(lambda camera: turntable(camera, axis_sigma_deg=180.0), table=False),
    "turntable that has learnt": Case(
        lambda camera: turntable(camera, axis_sigma_deg=30.0).learned(solution(camera), edges(camera)), proposes=True
    ),
    "turntable that knows which way round": Case(lambda camera: turntable(camera, step_sign="unknown", sense=1)),
    "turntable come round": Case(lambda camera: turntable(camera, step_deg=360.0, step_sigma_deg=5.0)),
    "turntable to an earlier view": Case(lambda camera: turntable(camera, previous=9), proposes=True, shaken=0.03),
    "turntable to an earlier view, no table": Case(
        lambda camera: turntable(camera, previous=9), table=False, proposes=True, shaken=0.03
    ),
    "held": Case(held, proposes=True),
    "held to an earlier view": Case(lambda camera: replace(held(camera), previous=9), proposes=True, shaken=0.03),
    "poke": Case(poke),
    "velocity": Case(velocity, proposes=True),
    "velocity on a table": Case(
        lambda camera: VelocityPrior(TablePrior()).learned(solution(camera), ()), proposes=True
    ),
    "foreseen": Case(foreseen, proposes=True, shaken=0.03),
    "features": Case(lambda _: FeaturesPrior(), proposes=True, shaken=0.3),
    "held and table": Case(lambda camera: ProductPrior(held(camera), TablePrior()), proposes=True, shaken=0.03),
    "velocity and held": Case(lambda camera: ProductPrior(velocity(camera), held(camera)), proposes=True, shaken=0.03),
}
