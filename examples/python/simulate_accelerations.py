#!/usr/bin/env python3
"""Simulates the accelerations of a tower of masses and springs under ambient excitation, with a loss of stiffness at the end.

The tower is read from its structure file (masses and springs). On every mass acts a random force, independent of the others. Each mode is
integrated exactly for a force that is constant over a step (zero-order hold) of a quarter of the sampling interval; the sum of the modes is
filtered against aliasing, sampled, and gets the noise of the sensors.

Everything is drawn from --seed; the same seed gives the same records. Written are one file for each record, the temperatures
(conditions.csv, the side file of identify_and_post.py) and, for comparison only, the true stiffnesses and frequencies (truth.csv).
"""

import argparse
import csv
import tomllib
from datetime import datetime, timedelta, timezone
from pathlib import Path

import numpy as np
from scipy import io, linalg, signal

OVERSAMPLING = 4  # steps of the integration for one sample
SETTLING_S = 60.0  # time before each record, so that the motion is stationary when the record begins


def read_tower(path):
    """Names and values (kg) of the masses, and the springs with their two ends, from a structure file."""
    structure = tomllib.loads(path.read_text())
    if structure.get("simulation", "spring_mass") != "spring_mass":
        raise SystemExit(f"{path}: simulation = {structure['simulation']!r}, but this script knows masses and springs only")
    masses = {mass["name"]: mass["kg"] for mass in structure["mass"]}
    springs = {}
    for spring in structure["spring"]:
        if "n_per_m" not in spring:
            raise SystemExit(f"{path}: spring {spring['name']} has no n_per_m, which this script needs as its undamaged stiffness")
        springs[spring["name"]] = (spring["from"], spring["to"], spring["n_per_m"])
    return masses, springs, structure["modes"]


def modes_of(masses, springs, factors):
    """Natural frequencies in Hz, ascending, and mode shapes normalised to modal masses of 1 kg (columns)."""
    index = {name: i for i, name in enumerate(masses)}
    stiffness = np.zeros((len(masses), len(masses)))
    for name, (start, end, n_per_m) in springs.items():
        ends = np.array([float(i == index.get(end)) - float(i == index.get(start)) for i in range(len(masses))])
        stiffness += factors[name] * n_per_m * np.outer(ends, ends)
    squares, shapes = linalg.eigh(stiffness, np.diag(list(masses.values())))
    return np.sqrt(squares) / (2 * np.pi), shapes


def accelerations(frequencies_hz, shapes, settings, rng):
    """One record in m/s², one row a sample: ambient forces with a standard deviation that differs from record to record, and sensor noise."""
    step_s = 1 / (settings.sampling_rate_hz * OVERSAMPLING)
    steps = round((settings.duration_s + SETTLING_S) / step_s)
    forces_n = rng.standard_normal((steps, len(shapes))) * 1000 * np.exp(0.3 * rng.standard_normal())
    motion = forces_n @ (shapes @ shapes.T)  # what the forces do at once: M⁻¹ F
    for frequency_hz, shape in zip(frequencies_hz, shapes.T):
        omega = 2 * np.pi * frequency_hz
        # Modal coordinate q: q'' + 2 ζ ω q' + ω² q = φᵀF. The acceleration without the direct part is −2 ζ ω q' − ω² q.
        motion_row = np.array([[-(omega**2), -2 * settings.damping * omega]])
        system = (np.vstack([[0.0, 1.0], motion_row]), np.array([[0.0], [1.0]]), motion_row, np.array([[0.0]]))
        numerator, denominator = signal.ss2tf(*signal.cont2discrete(system, step_s, method="zoh")[:4])
        motion += np.outer(signal.lfilter(numerator[0], denominator, forces_n @ shape), shape)
    sampled = signal.decimate(motion, OVERSAMPLING, ftype="fir", axis=0)[round(SETTLING_S * settings.sampling_rate_hz):]
    noise = settings.sensor_noise * sampled.std(axis=0) * rng.standard_normal(sampled.shape)
    return sampled + noise


def write_record(path, values, settings, started_at, sensors):
    """One record as NPZ, MAT or CSV. Values are stored with seven digits."""
    values = values.astype(np.float32)
    if settings.format == "csv":
        np.savetxt(path, values, fmt="%.7g", delimiter=",", header=",".join(sensors), comments="")
        return
    content = {"acceleration": values, "sampling_rate_hz": settings.sampling_rate_hz, "started_at": started_at}
    if settings.format == "npz":
        np.savez(path, **content)
    else:
        io.savemat(path, content)


def temperature_c(hours, rng):
    """A winter: a daily course about 4 °C, slow changes of the weather, and half a degree of noise."""
    slow = 5 * np.sin(2 * np.pi * hours / (9.3 * 24)) + 3 * np.sin(2 * np.pi * hours / (4.1 * 24) + 1)
    return 4 + slow + 3 * np.sin(2 * np.pi * (hours - 9) / 24) + 0.5 * rng.standard_normal()


def read_arguments():
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    here = Path(__file__).parent
    parser.add_argument("--structure", type=Path, default=here / "tower.toml", help="structure file [tower.toml beside this script]")
    parser.add_argument("--out", type=Path, default=Path("records"), help="folder for the records [records]")
    parser.add_argument("--healthy", type=int, default=60, help="undamaged records [60]")
    parser.add_argument("--damaged", type=int, default=40, help="records after the loss [40]")
    parser.add_argument("--spring", default="storey2", help="the spring that loses stiffness [storey2]")
    parser.add_argument("--loss", type=float, default=0.08, help="share of its stiffness that is lost [0.08]")
    parser.add_argument("--duration-s", type=float, default=600.0, help="length of a record [600]")
    parser.add_argument("--sampling-rate-hz", type=float, default=50.0, help="[50]")
    parser.add_argument("--damping", type=float, default=0.01, help="share of critical damping, of every mode [0.01]")
    parser.add_argument("--sensor-noise", type=float, default=0.05, help="standard deviation of the sensor noise, as a share of the motion [0.05]")
    parser.add_argument("--per-degree", type=float, default=-0.0004, help="relative change of all stiffnesses for each °C above 4 °C [-0.0004, steel]")
    parser.add_argument("--start", default="2026-01-05T00:00:00Z", help="time of the first record [2026-01-05T00:00:00Z]")
    parser.add_argument("--every-h", type=float, default=6.0, help="hours from record to record [6]")
    parser.add_argument("--format", choices=["npz", "mat", "csv"], default="npz", help="[npz]")
    parser.add_argument("--seed", type=int, default=1, help="[1]")
    return parser.parse_args()


def main():
    settings = read_arguments()
    masses, springs, modes = read_tower(settings.structure)
    if settings.spring not in springs:
        raise SystemExit(f"--spring {settings.spring}: the structure has the springs {', '.join(springs)}")
    if not 0 <= settings.loss < 1:
        raise SystemExit(f"--loss {settings.loss}: must be at least 0 and below 1")
    settings.out.mkdir(parents=True, exist_ok=True)
    start = datetime.fromisoformat(settings.start).astimezone(timezone.utc)
    with open(settings.out / "conditions.csv", "w", newline="") as side, open(settings.out / "truth.csv", "w", newline="") as true:
        conditions, truth = csv.writer(side), csv.writer(true)
        conditions.writerow(["record", "measured_at", "temperature_c"])
        truth.writerow(["record", "damaged", *springs, *(f"f{mode + 1}_hz" for mode in range(modes))])
        for record in range(settings.healthy + settings.damaged):
            rng = np.random.default_rng([settings.seed, record])
            started = start + timedelta(hours=settings.every_h * record)
            temperature = temperature_c(settings.every_h * record, rng)
            damaged = record >= settings.healthy
            factors = {name: 1 + settings.per_degree * (temperature - 4) for name in springs}
            factors[settings.spring] *= 1 - settings.loss * damaged
            frequencies_hz, shapes = modes_of(masses, springs, factors)
            name = started.strftime("%Y-%m-%dT%H-%M-%SZ") + "." + settings.format
            values = accelerations(frequencies_hz, shapes, settings, rng)
            write_record(settings.out / name, values, settings, started.isoformat(), list(masses))
            conditions.writerow([name, started.isoformat(), f"{temperature:.2f}"])
            stiffnesses = [f"{factors[spring] * springs[spring][2]:.7g}" for spring in springs]
            truth.writerow([name, int(damaged), *stiffnesses, *(f"{frequency:.6f}" for frequency in frequencies_hz[:modes])])
    print(f"{settings.healthy} healthy and {settings.damaged} damaged records of {settings.duration_s:g} s in {settings.out}")


if __name__ == "__main__":
    main()
