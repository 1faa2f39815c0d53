"""What the camera shows, against rays cast apart; what it costs; and how policies fly by it.

``python -m benchmarks.camera [--poses 10000] [--repeats 7] [--checkpoints PATH ...] [--out PAGE]``
prints a table and writes it. The ray caster (``benchmarks/hidden/ray_caster.py``) is NumPy in
float64 and shares no code with the package. Checkpoints, of ids with gate corners, are flown
on the shipped black box, whose states are seen through the same camera.
"""

import statistics
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import report
from benchmarks.env_speed import PLAIN, Contestant, jax_contestant, measure, ratios
from benchmarks.hidden import ray_caster
from benchmarks.hidden.ray_caster import Image

SEED = 0
CORNERS, MASK = "FlyTrackCorners-v0", "FlyTrackMask-v0"
COSTS = (CORNERS, "FlyTrackCornersNoisy-v0", "FlyTrackCornersRobust-v0")
IMAGES = {
    "as by default": Image(120.0, 40.0, 640, 480),
    "barrel distortion": Image(100.0, 25.0, 320, 240, -0.2, 0.02),
    "pincushion distortion": Image(90.0, -10.0, 640, 480, 0.1, 0.05),
}
MASK_IMAGE = Image(120.0, 40.0, 64, 64)
DIFFERENCE = 1e-6  # of a finite difference, m or of a quaternion's part
NUM_GRADIENTS = 100
NUM_FRAMES = 1024
BAD_DETECTOR = {"noise_px": 2.0, "missed": 0.05, "latency_s": 0.02}
STEPS, FLIGHTS, LAPS, FLIGHT_SEED = 2500, 256, 3, 100


def project_corners(image: Image, position: Any, quaternion: Any, gate: Any) -> tuple[Any, Any]:
    """Return the corners of a gate, right and down in px, (4, 2), and whether they are visible."""
    import jax.numpy as jnp

    from flytrack_env import camera
    from flytrack_env.quaternion import Quaternion, Vec3

    size = float(image.width), float(image.height)
    lens = camera.make_lens(image.field_of_view_deg, *size, image.k1, image.k2)
    axes = camera.camera_axes(Quaternion(*quaternion).normalize(), image.pitch_deg)
    corners = camera.opening_corners(axes, Vec3(*position), gate)
    pixels = [camera.project(corner, lens) for corner in corners]
    coordinates = jnp.stack([jnp.stack(pixel[:2]) for pixel in pixels])
    return coordinates, jnp.stack([jnp.asarray(pixel.is_visible) for pixel in pixels])


def draw_poses(
    count: int,
) -> tuple[Any, ray_caster.Gates, np.ndarray, np.ndarray, np.ndarray]:
    """Draw poses about the course; return it, its gates, positions, quaternions and gate numbers.

    Positions and quaternions are float32, for both cameras.
    """
    from flytrack_env import FlyTrack

    env = FlyTrack()
    gates = ray_caster.read_gates(env.track)
    positions, quaternions, indices = ray_caster.draw_poses(SEED, count, gates)
    pose = positions.astype(np.float32), quaternions.astype(np.float32)
    return env.default_params.course, gates, *pose, indices


def corner_figures(num_poses: int) -> list[report.Figure]:
    """Return how far corners are from those of rays cast apart, and how often flags differ."""
    import jax

    course, gates, positions, quaternions, indices = draw_poses(num_poses)
    figures = []
    for name, image in IMAGES.items():
        find = jax.jit(
            jax.vmap(lambda p, q, i, image=image: project_corners(image, p, q, course.gate(i)))
        )
        projected, is_visible = map(np.asarray, find(positions, quaternions, indices))
        expected, _ = ray_caster.find_corners(positions, quaternions, gates, indices, image)
        is_inside = (np.abs(expected) <= np.array([image.width, image.height]) / 2.0).all(axis=-1)
        errors_px = np.abs(projected - expected).max(axis=-1)[is_visible & is_inside]
        figures += [
            report.Figure(
                f"corners, {name}: largest error (px)",
                "at most 0.01",
                f"{errors_px.max():.4f}",
                errors_px.size,
            ),
            report.Figure(
                f"corners, {name}: visible or not, as by rays",
                "",
                f"{100.0 * np.mean(is_visible == is_inside):.3f} %",
                is_visible.size,
            ),
        ]
    return figures


def mask_figure(num_poses: int) -> report.Figure:
    """Return the share of a mask's pixels that are those of rays cast apart."""
    import jax

    from flytrack_env import camera
    from flytrack_env.quaternion import Quaternion, Vec3

    course, gates, positions, quaternions, _ = draw_poses(num_poses)

    def draw(position: Any, quaternion: Any) -> Any:
        return camera.draw_frames(
            camera.CameraPose(Vec3(*position), Quaternion(*quaternion)),
            course.gates,
            MASK_IMAGE.pitch_deg,
            MASK_IMAGE.field_of_view_deg,
            (MASK_IMAGE.height, MASK_IMAGE.width),
        )

    masks = np.asarray(jax.jit(jax.vmap(draw))(positions, quaternions))[..., 0] > 0
    share = np.mean(masks == ray_caster.cast_masks(positions, quaternions, gates, MASK_IMAGE))
    return report.Figure(
        "pixels of masks as by rays", "at least 99.9 %", f"{100 * share:.4f} %", masks.size
    )


def gradient_figure() -> report.Figure:
    """Return the largest relative error of gradients of corners against finite differences."""
    import jax

    image = IMAGES["barrel distortion"]
    float32_course, _, positions, quaternions, indices = draw_poses(10 * NUM_GRADIENTS)
    weights = np.random.default_rng(SEED).normal(size=(4, 2))
    with jax.enable_x64(True):
        course = jax.tree.map(lambda leaf: np.asarray(leaf, float), float32_course)

        def value(pose: Any, index: Any) -> Any:
            projected, is_visible = project_corners(image, pose[:3], pose[3:], course.gate(index))
            return (weights * projected).sum(), is_visible.all()

        poses = np.concatenate([positions, quaternions], axis=1).astype(float)
        evaluate = jax.jit(jax.vmap(jax.value_and_grad(value, has_aux=True)))
        (_, is_visible), gradients = evaluate(poses, indices)
        rows = np.flatnonzero(is_visible)[:NUM_GRADIENTS]
        shifts = DIFFERENCE * np.eye(poses.shape[1])
        ends = [
            np.stack(
                [evaluate(poses[rows] + sign * shift, indices[rows])[0][0] for shift in shifts]
            )
            for sign in (1.0, -1.0)
        ]
    numeric = (ends[0] - ends[1]).T / (2.0 * DIFFERENCE)
    sizes = np.linalg.norm(numeric, axis=1, keepdims=True)
    errors = np.abs(np.asarray(gradients)[rows] - numeric) / sizes
    return report.Figure(
        "gradients of corners, largest error over their size",
        "at most 1e-4",
        f"{errors.max():.1e}",
        len(rows),
    )


def frames_contestant(name: str) -> Contestant:
    """Return the drawing of masks of drones that have flown at random."""
    import jax

    import flytrack_env

    env = flytrack_env.make(MASK)
    params = env.default_params
    keys = jax.random.split(jax.random.key(SEED), NUM_FRAMES)
    _, states = jax.jit(jax.vmap(env.reset, in_axes=(0, None)))(keys, params)
    draw = jax.jit(
        jax.vmap(lambda state, params: env.observe(None, state, None, params), (0, None))
    )

    def run() -> None:
        for _ in range(20):
            jax.block_until_ready(draw(states, params))

    return Contestant(name, 20 * NUM_FRAMES / 1e6, run)


def speed_figures(repeats: int) -> list[report.Figure]:
    """Return the costs of steps with corners, and how many masks are drawn and flown a second."""
    drawn, flown = "masks drawn", "masks, vmap(step)"
    entries = [jax_contestant(PLAIN, "FlyTrack-v0")]
    entries += [jax_contestant(env_id, env_id) for env_id in COSTS]
    entries += [frames_contestant(drawn), jax_contestant(flown, MASK, length=20)]
    rates = measure(entries, repeats)
    figures = []
    for env_id in COSTS:
        costs = ratios(rates, PLAIN, env_id)
        figures.append(
            report.Figure(
                f"cost of {env_id} vmap(step), 1,024, over the plain step",
                "at most 1.6" if env_id == CORNERS else "",
                report.median_and_spread(costs, ".2f"),
                repeats,
            )
        )
    labels = {
        drawn: "masks of 64 x 64 drawn a second, one core",
        flown: "the same in vmap(step), which draws the final observation, too",
    }
    for name, label in labels.items():
        rate = statistics.median(rates[name]) * 1e3
        goal = "at least 100 k" if name == drawn else ""
        figures.append(report.Figure(label, goal, f"{rate:.0f} k", repeats))
    return figures


def flight_rows(checkpoints: tuple[Path, ...]) -> list[list[Any]]:
    """Return a row for each policy: how it flies by a perfect detector, and by a bad one."""
    from baselines.purejaxrl_ppo.evaluate import EvaluationSettings, Report
    from flytrack_env.wrappers import CornersParams, GateCorners, layers_of

    rows = []
    for path in checkpoints:
        row: list[Any] = [path.parent.name]
        for changes in ({}, BAD_DETECTOR):
            settings = EvaluationSettings(
                path, STEPS, episodes=FLIGHTS, laps=LAPS, seed=FLIGHT_SEED
            )
            flown = Report(settings)
            layer = next(part for part in layers_of(flown.env) if isinstance(part, GateCorners))
            detector = CornersParams(**changes)
            flown.params = layer.with_own_params(flown.params, detector)
            flown.count(flown.fly())
            lap_s = flown.numbers["flying_lap_s"]["mean"]
            above = flown.numbers["optimal"]["flying_lap_s"]["mean_percent_above"]
            row += [
                f"{100.0 * flown.numbers['success']['share']:.1f} %",
                f"{flown.numbers['gates_mean']:.1f}",
                "-" if lap_s is None else f"{lap_s:.2f}",
                "-" if above is None else f"{1.0 + above / 100.0:.2f}",
            ]
        rows.append(row)
    return rows


def main(
    poses: int = 10_000,
    repeats: int = 7,
    checkpoints: tuple[Path, ...] = (),
    out: Path | None = None,
) -> None:
    """Measure, print and write.

    Args:
        poses: that corners and masks are compared at.
        repeats: rounds of the speeds.
        checkpoints: of policies to fly.
        out: page.
    """
    core = report.pin_to_one_core()
    figures = [*corner_figures(poses), mask_figure(poses), gradient_figure()]
    header = "policy | finish, perfect detector | gates | flying lap (s) | times optimal"
    bad = "finish, bad detector | gates, bad | flying lap, bad (s) | times optimal, bad"
    report.fill_page(
        out,
        "camera",
        figures=report.figures_table([*figures, *speed_figures(repeats)]),
        flights=report.table(f"{header} | {bad}", flight_rows(checkpoints)),
        seed=SEED,
        flight_seed=FLIGHT_SEED,
        poses=poses,
        repeats=repeats,
        core=core,
    )


if __name__ == "__main__":
    report.command(main)
