"""What ``flytrack adapt`` makes of ten seconds of flight: ``python -m benchmarks.adapt [--page]``.

The shipped robust policy flies the hidden plants of suite v1 in three motions, and is adapted to
each by the log of that flight. Beside it fly the policy as it was, the same descent on the refitted
base model, without any name, policies that were trained once for plants around its model
(``benchmarks.adapt_rivals``), a network that learns what the policy's model misses
(``benchmarks.adapt_residual``), and the limit, a descent on the plant itself. Between them come
plants without effects that the policy claims to be made for: nothing is to be adapted to. Last come
plants of other batteries and masses, and configurations of real firmware (docs/firmware.md), whose
settings are known. Appends a line a trial to docs/results/adapt.jsonl, and a later run resumes
there; ``--page`` writes docs/results/adapt.md from the last commit of each kind of trial, length of
a log and seed, and of firmware from the last flight of each configuration.
"""

import time
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy import stats
from scipy.spatial.transform import Rotation

from baselines.purejaxrl_ppo import Checkpoint, load_checkpoint
from baselines.purejaxrl_ppo.checkpoint_env import plant_env
from baselines.purejaxrl_ppo.flights import fly_many
from baselines.purejaxrl_ppo.polish import LostError, polish
from benchmarks import report
from benchmarks.adapt_residual import adapt_with_residual
from benchmarks.adapt_rivals import POLICIES, train_rival
from benchmarks.diagnosis import MOTION_OF, model_of
from benchmarks.firmware import KINDS, SETUPS, of_settings_and_body
from benchmarks.loop.plants import draw_base
from benchmarks.report import Line
from firmware import Betaflight, Body
from flytrack_bench import load_suite
from flytrack_bench.hidden import MOTIONS, HiddenPlant, Truth
from flytrack_env import ModelParameters, nominal_parameters
from flytrack_env.battery import Battery
from flytrack_env.dynamics import VOLTAGE_TERMS
from flytrack_env.effects import BY_NAME
from flytrack_env.model_file import model_as_json, model_from_json
from flytrack_env.plants import Plant
from flytrack_loop import race
from flytrack_loop.adapt import Adapted, Settings, adapt, improve
from flytrack_loop.stages import BATCH, log_of_flights, rounded
from flytrack_sysid import Diagnosis, FlightLog
from flytrack_sysid.diagnosis.plausible import PlausibleModels
from flytrack_sysid.inference.parameters import to_vector
from flytrack_sysid.sensors import measure

LINES = report.RESULTS / "adapt.jsonl"
POLICY, DT_S, NUM_LAPS, NUM_STEPS = "robust", 0.01, 25, 1000
SECONDS, SEED = 10.0, 1  # of a log that refitted base and limit are made of, too
Kind = Literal["plant", "unchanged", "rivals", "residual", "size", "firmware"]
PLANT: Kind = "plant"
UNCHANGED: Kind = "unchanged"
RIVALS: Kind = "rivals"
RESIDUAL: Kind = "residual"
SIZE: Kind = "size"
FIRMWARE: Kind = "firmware"
SIZES = ((12.6, 0.12), (16.8, 0.3), (21.0, 0.5), (25.2, 0.75), (50.4, 4.0))  # full, V; mass, kg
# Set-ups, and changes of the stock one.
CONFIGURATIONS = (*SETUPS, "P and D term", "a weak motor", "drag", "mass", "bent thrust")
NUM_PLANTS, NUM_UNCHANGED = 8, 20
LIMIT, NETWORK = "limit", "residual network"
FIRST = "adapted to the first of two logs"
ENTRIES = ("nothing", *POLICIES, NETWORK, "refitted base", "adapted", LIMIT)
LIMIT_SETTINGS = Settings().polishing._replace(updates=300, curriculum_steps=0, offset_limit=0.95)
# XLA does not compile the gradient of parts of 1 ms within eight minutes.
WITH_LIMIT = ("handout", "semi_implicit")
STARTS, START_SEED = 256, 7


class Trial(NamedTuple):
    """A plant, its motion, the seconds in its log, and the seed of flights, draws and starts."""

    kind: Kind
    number: int
    motion: str
    seconds: float
    seed: int


def list_trials(seconds: float, seed: int) -> list[Trial]:
    """Return all trials; kinds and motions are even among the first ones."""
    plants = [
        Trial(PLANT, 1 + index, MOTIONS[(index + turn) % len(MOTIONS)], seconds, seed)
        for turn in range(len(MOTIONS))
        for index in range(NUM_PLANTS)
    ]
    unchanged = [
        Trial(UNCHANGED, index, MOTIONS[index % len(MOTIONS)], seconds, seed)
        for index in range(NUM_UNCHANGED)
    ]
    mixed = []
    for index, trial in enumerate(plants):
        rivals = [trial._replace(kind=kind) for kind in (RIVALS, RESIDUAL)]
        mixed += [trial, *rivals, *unchanged[2 * index : 2 * index + 2]]
    sizes = [
        Trial(SIZE, 1 + index, MOTIONS[index % len(MOTIONS)], seconds, seed)
        for index in range(len(SIZES))
    ]
    firmware = [
        Trial(FIRMWARE, number, "continuous", seconds, seed)
        for number in range(len(CONFIGURATIONS))
    ]
    return [*mixed, *sizes, *firmware]


def fly(plant: Plant, motion: str, policy: Checkpoint, seconds: float, seed: int) -> FlightLog:
    """Return the log, by common sensors, of a policy's flights of a total length.

    An accelerometer feels the force in the axes in which it acts, which depend on the motion.
    """
    env = plant_env(policy, plant)
    flights = fly_many(env, policy.policy, seed, BATCH, NUM_STEPS, NUM_LAPS)
    log = log_of_flights(flights, DT_S, seed, seconds, noise=0.0)
    log = log.select(np.arange(len(log)) < round(seconds / DT_S))
    gravity = float(nominal_parameters().g)
    if motion != "handout":
        log = replace(log, channels={**log.channels, "a": felt_after_step(log, gravity)})
    return measure(log, 1.0, gravity, np.random.default_rng(seed))


def felt_after_step(log: FlightLog, gravity: float) -> np.ndarray:
    """Return accelerations that ``measure`` reads as the force in the axes after each step."""
    attitude = Rotation.from_quat(log["q"], scalar_first=True)
    before = Rotation.from_quat(
        log["q"][np.arange(len(log)) - np.where(log.is_start(), 0, 1)], scalar_first=True
    )
    lifted = log["a"] + [0.0, 0.0, gravity]
    return (before * attitude.inv()).apply(lifted) - [0.0, 0.0, gravity]


def raced(policy: Checkpoint, plant: Plant) -> Line:
    """Return the share of starts that finish, and the mean flying lap, s."""
    outcome = race(policy, plant_env(policy, plant), START_SEED, STARTS)
    return {"success": outcome.success, "flying_lap_s": rounded(outcome.flying_lap_s)}


def format_lap(entry: Line | None) -> str:
    """Return who finishes, and the flying lap; a dash if nothing was flown."""
    if entry is None:
        return "-"
    lap_s = entry["flying_lap_s"]
    return f"{entry['success']:.1%}, " + ("-" if lap_s is None else f"{lap_s:.3f} s")


def figures(plants: list[Line], unchanged: list[Line]) -> list[report.Figure]:
    """Return the figures of the page, of trials that were not refused."""

    def count_true(name: str, target: str, flags: list[bool]) -> report.Figure:
        return report.Figure(name, target, f"{sum(flags)} of {len(flags)}", len(flags))

    finishes, against = [], []
    for name in flown_entries(plants):
        flown = [line for line in plants if name in line["entries"]]
        finishes.append(
            count_true(
                f"hidden plants on which 99 % of starts finish: {name}",
                "all" if name == "adapted" else "",
                does_finish(flown, name),
            )
        )
        if name != "adapted":
            ratio = "races finished a second over those of the adapted policy, interquartile mean"
            target = "below 1" if name in (*POLICIES, NETWORK) else ""
            ratios = [speed_ratio(line, name) for line in flown]
            against.append(report.Figure(f"{ratio}: {name}", target, *describe_ratios(ratios)))
    laps_s = [
        [line["entries"][name]["flying_lap_s"] for name in ("adapted", LIMIT)]
        for line in plants
        if LIMIT in line["entries"]
    ]
    over_limit = [adapted_s / limit_s for adapted_s, limit_s in laps_s if adapted_s and limit_s]
    cpu_s = [line["cpu_s"] for line in plants]
    # A law of the policy's model that is not in the plant is a difference, and is to be named. So
    # is a scale of the thrust: the thrust map of each plant differs from the model's.
    known = {*load_checkpoint(POLICY).meta["model"]["effects"], "thrust_scale"}
    invented = [
        any(
            name in BY_NAME and name not in known and f"{name}(" not in line["hidden"]
            for name in line["named"]
        )
        for line in plants
    ]
    kept = [line["is_new"] is False and line["verdict"] == "consistent" for line in unchanged]
    return [
        *finishes,
        *against,
        report.Figure(
            "flying lap, adapted over limit, median (all)",
            "1.05",
            report.median_and_spread(over_limit, ".3f"),
            len(over_limit),
        ),
        count_true(
            "mean flying lap within what was expected of a flight", "", are_as_expected(plants)
        ),
        count_true(
            "hidden plants with a named effect that neither they nor the policy's model have",
            "none",
            invented,
        ),
        report.Figure(
            "CPU s from log to policy, median (all)",
            "60",
            report.median_and_spread(cpu_s, ",.0f"),
            len(plants),
        ),
        count_true(
            "plants that are what the policy was made for: nothing to adapt to", "20 of 20", kept
        ),
    ]


def flown_entries(plants: list[Line]) -> list[str]:
    """Return the entries that flew any of some plants."""
    return [name for name in ENTRIES if any(name in line["entries"] for line in plants)]


def speed_ratio(line: Line, name: str) -> float:
    """Return how often an entry finishes in a time, over how often the adapted policy does."""
    rates = [
        entry["success"] / entry["flying_lap_s"] if entry["flying_lap_s"] else 0.0
        for entry in (line["entries"][name], line["entries"]["adapted"])
    ]
    return rates[0] / rates[1] if rates[1] else np.inf


def describe_ratios(ratios: list[float]) -> tuple[str, int]:
    """Return the interquartile mean with its bootstrapped 95 % interval over plants, and how many.

    The mean of the middle half is that of R. Agarwal et al., arXiv 2108.13264.
    """
    middle = partial(stats.trim_mean, proportiontocut=0.25, axis=-1)
    if len(ratios) < 2:
        return f"{middle(ratios):.3f}", len(ratios)
    interval = stats.bootstrap(
        (ratios,), middle, method="percentile", rng=np.random.default_rng(SEED)
    ).confidence_interval
    return f"{middle(ratios):.3f} ({interval.low:.3f} to {interval.high:.3f})", len(ratios)


def plants_table(plants: list[Line]) -> str:
    """Return a row for each hidden plant."""
    names = flown_entries(plants)
    rows = []
    for line in sorted(plants, key=lambda line: (line["number"], line["motion"])):
        entries = line["entries"]
        laps = [format_lap(entries.get(name)) for name in names]
        expected = line.get("expected_lap_s")
        expected_text = "{:.3f} to {:.3f} s".format(*expected) if expected else "-"
        named = ", ".join(line.get("named", ())) or line.get("refused", "nothing")
        head = [str(line["number"]), line["motion"], line.get("motion_found", "-"), line["flights"]]
        rows.append([*head, line["hidden"], named, *laps, expected_text])
    header = ["plant", "motion", "found", "flights", "hidden", "named", *names, "expected"]
    return report.table(header, rows)


def entries_of_rivals(lines: list[Line], plant: Line) -> dict[str, Line]:
    """Return the races of the rivals on a plant."""
    entries: dict[str, Line] = {}
    for kind in (RIVALS, RESIDUAL):
        for line in report.select(lines, kind=kind, number=plant["number"], motion=plant["motion"]):
            entries |= line["entries"]
    return entries


def logs_table(plants: list[Line]) -> str:
    """Return a row for each length of the log: of each seed, and of all."""
    rows = []
    for seconds in sorted({line["seconds"] for line in plants}):
        of_length = report.select(plants, seconds=seconds)
        seeds = sorted({line["seed"] for line in of_length})
        alike = {str(seed): report.select(of_length, seed=seed) for seed in seeds}
        for seed, lines in [*alike.items(), *([("all", of_length)] if len(seeds) > 1 else [])]:
            flown = [line for line in lines if "is_new" in line]
            inside = are_as_expected(flown)
            counts = f"{sum(does_finish(flown, 'adapted'))} of {len(lines)}"
            expected = f"{sum(inside)} of {len(inside)}"
            cpu_s = f"{np.median([line['cpu_s'] for line in flown]):.0f}" if flown else "-"
            commit = lines[0]["commit"] if seed in alike else ""
            refused = f"{len(lines) - len(flown)}"
            rows.append([f"{seconds:g}", seed, counts, expected, refused, cpu_s, commit])
    header = (
        "seconds | seed | 99 % finish, adapted | lap as expected | refused | CPU s, median | commit"
    )
    return report.table(header, rows)


def does_finish(plants: list[Line], name: str) -> list[bool]:
    """Return for each plant whether 99 % of an entry's starts finish."""
    return [line["entries"][name]["success"] >= 0.99 for line in plants]


def are_as_expected(plants: list[Line]) -> list[bool]:
    """Return whether the mean flying lap is as expected, for plants of which both are known."""
    flags = []
    for line in plants:
        expected_s, lap_s = line["expected_lap_s"], line["entries"]["adapted"]["flying_lap_s"]
        if expected_s and lap_s:
            flags.append(expected_s[0] <= lap_s <= expected_s[1])
    return flags


def crafts_table(lines: list[Line]) -> str:
    """Return a row for each craft that the policy was not made for."""
    rows = []
    has_two_logs = any(FIRST in line["entries"] for line in lines)
    entered = ["nothing", FIRST, "adapted"] if has_two_logs else ["nothing", "adapted"]
    for line in sorted(lines, key=lambda line: line["number"]):
        entries, named = line["entries"], line.get("named")
        flown_s = entries.get("adapted", {}).get("flying_lap_s")
        simulated_s = line.get("simulated_lap_s")
        gap = f"{flown_s / simulated_s - 1.0:+.2%}" if flown_s and simulated_s else "-"
        verdict = line.get("refused") or line["verdict"]
        laps = [format_lap(entries.get(name)) for name in entered]
        cpu_s = str(line.get("cpu_s", "-"))
        names = "-" if named is None else ", ".join(named) or "nothing"
        rows.append([line["hidden"], verdict, names, *laps, gap, cpu_s, line["commit"]])
    last = ("gap to its simulator", "CPU s", "commit")
    return report.table(("craft", "verdict", "named", *entered, *last), rows)


def describe_not_flown(lines: list[Line]) -> str:
    """Return which configurations of firmware have no line."""
    flown = {line["hidden"] for line in lines}
    missing = [name for name in CONFIGURATIONS if name not in flown]
    return f"Not flown: {', '.join(missing)}." if missing else ""


def last_lines(lines: list[Line]) -> list[Line]:
    """Return the lines of the last commit of each kind of trial, length of a log and seed.

    A flight of firmware takes minutes, so that of these the last line of each configuration counts.
    """

    def group(line: Line) -> tuple[Any, ...]:
        numbers = [line["number"]] if line["kind"] == FIRMWARE else []
        return (line["kind"], line["seconds"], line["seed"], *numbers)

    last = {group(line): line["commit"] for line in lines}
    return [line for line in lines if line["commit"] == last[group(line)]]


def write_page(all_lines: list[Line]) -> None:
    """Write the page of lines."""
    of_all_logs = report.good_lines(all_lines)
    lines = report.select(of_all_logs, seconds=SECONDS, seed=SEED)
    firmware = report.select(lines, kind=FIRMWARE)
    plants = [
        {**line, "entries": line["entries"] | entries_of_rivals(lines, line)}
        for line in report.select(lines, kind=PLANT)
    ]
    unchanged = report.select(lines, kind=UNCHANGED)
    whole = [line for line in plants if "is_new" in line]
    judged = [line for line in unchanged if "is_new" in line]
    deviations = [
        f"{line['motion']} {line['number']}: {', '.join(line['named']) or line['verdict']}"
        for line in judged
        if line["verdict"] != "consistent"
    ]
    refused = len(unchanged) - len(judged)
    text = f"{len(judged)} of {NUM_UNCHANGED} were flown"
    text += f", and {refused} more refused." if refused else "."
    if deviations:
        text += f" Something was found on {'; '.join(deviations)}."
    commits = {line["kind"]: line["commit"] for line in lines if line["kind"] != FIRMWARE}
    trials = list_trials(SECONDS, SEED)
    planned = sum(trial.kind == PLANT for trial in trials)
    report.fill_page(
        report.RESULTS / "adapt.md",
        "adapt",
        seconds=SECONDS,
        seed=SEED,
        starts=STARTS,
        limit_updates=LIMIT_SETTINGS.updates,
        limit_offset=LIMIT_SETTINGS.offset_limit,
        figures=report.figures_table(figures(whole, judged)),
        not_run=f"{len(plants)} of {planned} pairs of plant and motion were flown, "
        f"{len(plants) - len(whole)} of them refused as a log. "
        f"Errors: {len(all_lines) - len(of_all_logs)}.",
        plants=plants_table(plants),
        logs=logs_table(report.select(of_all_logs, kind=PLANT)),
        sizes=crafts_table(report.select(lines, kind=SIZE)),
        firmware=crafts_table(firmware),
        firmware_not_run=describe_not_flown(firmware),
        unchanged=text,
        commits=", ".join(f"{kind} {commit}" for kind, commit in commits.items()),
        machine=lines[-1]["machine"],
    )


def measure_trial(trial: Trial) -> Line:
    """Return what is made of a trial's plant."""
    kinds = {
        PLANT: measure_plant,
        UNCHANGED: measure_unchanged,
        RIVALS: measure_rivals,
        RESIDUAL: measure_residual,
        SIZE: measure_size,
        FIRMWARE: measure_firmware,
    }
    return kinds[trial.kind](trial)


def make_plant(trial: Trial) -> HiddenPlant:
    """Return the hidden plant of a trial."""
    craft = load_suite("v1").chosen((f"plant_{trial.number}",))[0].craft
    assert craft is not None
    return HiddenPlant(replace(craft, motion=trial.motion))


def measure_rivals(trial: Trial) -> Line:
    """Return the races of policies that were trained once, for plants around a model."""
    plant = make_plant(trial)
    policies = {name: load_checkpoint(train_rival(name)) for name in POLICIES}
    return {"entries": {name: raced(policy, plant) for name, policy in policies.items()}}


def measure_residual(trial: Trial) -> Line:
    """Return the race of a policy that was adapted to its model and a network."""
    plant, policy = make_plant(trial), load_checkpoint(POLICY)
    log = fly(plant, trial.motion, policy, trial.seconds, trial.seed)
    model = model_from_json(policy.meta["model"], "model")
    adapted = adapt_with_residual(log, policy, model, trial.seed)
    return {"entries": {NETWORK: raced(adapted, plant)}}


def improve_on_plant(policy: Checkpoint, plant: HiddenPlant, seed: int) -> Checkpoint:
    """Return a policy after a descent through the equations of the plant, which nobody knows."""
    params = polish(plant_env(policy, plant), policy.policy, seed, LIMIT_SETTINGS)
    return policy._replace(params=params)


def measure_plant(trial: Trial) -> Line:
    """Return what each way makes of a hidden plant's log."""
    plant, policy = make_plant(trial), load_checkpoint(POLICY)
    result, adapted = measure_adapted(trial, plant, policy)
    result["hidden"] = plant.truth.text()
    if adapted is None or (trial.seconds, trial.seed) != (SECONDS, SEED):
        return result
    entries = result["entries"]
    refitted = adapt_to_base(policy, adapted.diagnosis, trial.seed)
    entries["refitted base"] = raced(refitted.checkpoint, plant)
    if trial.motion in WITH_LIMIT:
        with suppress(LostError):  # a policy that was kept may crash, and has no gradient then
            limit = improve_on_plant(adapted.checkpoint, plant, trial.seed)
            entries[LIMIT] = raced(limit, plant)
    return result


class SizedPlant(HiddenPlant):
    """A hidden plant of another battery and mass, whose thrust over weight is as it was."""

    def __init__(self, truth: Truth, full_v: float, mass: float):
        per_volt, coeffs = float(Battery().full_v) / full_v, list(truth.coeffs)
        coeffs[VOLTAGE_TERMS:] = [one * per_volt for one in coeffs[VOLTAGE_TERMS:]]
        effects = dict(truth.effects)
        if "voltage_sag" in effects:
            effects["voltage_sag"] = {"at_full_v": effects["voltage_sag"]["at_full_v"] / per_volt}
        super().__init__(
            replace(
                truth,
                coeffs=tuple(one * mass / truth.mass for one in coeffs),
                mass=mass,
                drain=truth.drain / per_volt,
                effects=effects,
            )
        )
        self.battery = sized_battery(full_v)


def sized_battery(full_v: float) -> Battery:
    """Return a battery that ends at the same fraction of its highest voltage as the handout's."""
    empty_v = full_v * float(Battery().empty_v) / float(Battery().full_v)
    return Battery(full_v, empty_v, empty_v, full_v)


def measure_size(trial: Trial) -> Line:
    """Return what is made of a log of a craft whose battery and mass are known, and other."""
    full_v, mass = SIZES[trial.number - 1]
    plant = SizedPlant(make_plant(trial).truth, full_v, mass)
    policy = load_checkpoint(POLICY)
    craft = model_from_json(policy.meta["model"], "model").resized(mass, sized_battery(full_v))
    result, _ = measure_adapted(trial, plant, policy, craft)
    return {**result, "hidden": f"{full_v:g} V, {mass:g} kg: {plant.truth.text()}"}


def measure_firmware(trial: Trial) -> Line:
    """Return what is made of a log of real firmware, whose settings are known, on a body."""
    name = CONFIGURATIONS[trial.number]
    changes = dict(SETUPS.get(name, {}))
    if name in KINDS:
        changes |= KINDS[name].draw(np.random.default_rng([trial.seed, trial.number]))
    settings, body = of_settings_and_body(changes)
    policy = load_checkpoint(POLICY)
    with Betaflight(settings, Body(**body), seed=trial.seed) as plant:
        craft = plant.nominal_model()
        result, adapted = measure_adapted(trial, plant, policy, craft)
        is_expected = all((*does_finish([result], "adapted"), *are_as_expected([result])))
        if adapted is not None and not is_expected:
            again, _ = measure_adapted(trial, plant, policy, craft, adapted.checkpoint)
            if "refused" not in again:
                again["entries"][FIRST] = result["entries"]["adapted"]
                again["cpu_s"] += result["cpu_s"]
                result = again
    return {**result, "hidden": name}


def measure_adapted(
    trial: Trial,
    plant: Plant,
    policy: Checkpoint,
    craft: ModelParameters | None = None,
    flown: Checkpoint | None = None,
) -> tuple[Line, Adapted | None]:
    """Return what is made of a plant's log, and the adapted policy; None if the log is refused.

    Args:
        flown: the policy whose flights are logged; None for the one that is adapted.
    """
    log = fly(plant, trial.motion, policy if flown is None else flown, trial.seconds, trial.seed)
    result: Line = {"flights": len(np.unique(log.segment))}
    entries = result["entries"] = {"nothing": raced(policy, plant)}
    begun_s = time.process_time()
    try:
        adapted = adapt(log, policy, trial.seed, craft=craft)
    except ValueError as error:
        return {**result, "refused": str(error)}, None
    result["cpu_s"] = round(time.process_time() - begun_s, 1)
    result |= about(adapted)
    entries["adapted"] = raced(adapted.checkpoint, plant)
    return result, adapted


def about(found: Adapted) -> Line:
    """Return what an adaptation found, and the flying lap that it expects, 95 %, s."""
    diagnosis, new = found.diagnosis, found.new
    expected = simulated_s = None
    if new is not None and new.is_complete.any():
        laps_s = new.lap_s[new.is_complete]
        expected = np.quantile(laps_s, (0.025, 0.975)).round(3).tolist()
        simulated_s = round(float(laps_s.mean()), 4)
    return {
        "motion_found": diagnosis.extended.motion.value,
        "named": [cause.effect for cause in diagnosis.causes],
        "verdict": diagnosis.verdict,
        "is_new": found.is_new,
        "expected_lap_s": expected,
        "simulated_lap_s": simulated_s,
    }


def adapt_to_base(policy: Checkpoint, diagnosis: Diagnosis, seed: int) -> Adapted:
    """Return a policy adapted to the refitted base model of a diagnosis, without any name."""
    base = diagnosis.base
    vector = to_vector(base)
    exact = PlausibleModels(base, vector, np.zeros((len(vector), 1)), vector, vector)
    trained_model = model_from_json(policy.meta["model"], "model")
    return improve(policy, trained_model, exact, diagnosis, seed, Settings(), lambda unit: ignore)


def ignore(done: int, total: int) -> None:
    """Show no progress."""


def measure_unchanged(trial: Trial) -> Line:
    """Return what is made of a plant without effects that the policy claims to be made for."""
    rng = np.random.default_rng([trial.seed, trial.number, NUM_UNCHANGED])
    truth = replace(draw_base(rng), motion=trial.motion)
    model = model_of(truth)._replace(motion=MOTION_OF[trial.motion])
    policy = load_checkpoint(POLICY)
    policy = policy._replace(meta={**policy.meta, "model": model_as_json(model)})
    log = fly(HiddenPlant(truth), trial.motion, policy, trial.seconds, trial.seed + trial.number)
    begun_s = time.process_time()
    try:
        adapted = adapt(log, policy, trial.seed)
    except ValueError as error:
        return {"refused": str(error)}
    return {**about(adapted), "cpu_s": round(time.process_time() - begun_s, 1)}


def main(
    seconds: float = SECONDS,
    seed: int = SEED,
    page: bool = False,
    kinds: tuple[Kind, ...] = (PLANT, UNCHANGED, RIVALS, RESIDUAL, SIZE, FIRMWARE),
    jobs: report.JobFlags = report.IN_THIS_PROCESS,
) -> None:
    """Run the trials that are missing, or write the page of those that are there.

    Args:
        seconds: of flight in a log.
        seed: of flights, draws and starts.
        page: write the page only.
        kinds: of trials that are run.
    """
    if page:
        write_page(last_lines(report.lines_in(LINES)))
    else:
        if RIVALS in kinds:
            for name in POLICIES:
                train_rival(name)
        trials = [trial for trial in list_trials(seconds, seed) if trial.kind in kinds]
        report.record_trials(LINES, trials, measure_trial, 1, jobs)


if __name__ == "__main__":
    report.command(main)
