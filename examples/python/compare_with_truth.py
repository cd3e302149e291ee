#!/usr/bin/env python3
"""How well identify_and_post.py found the modes of simulated records: identified against true values, as a table in Markdown.

    compare_with_truth.py --records records --identified identified.ndjson

For each mode: share of records that miss it, mean and standard deviation of the relative error of the frequency, the standard deviation that
pyOMA2 states (root mean square), the correlation of the error from one record to the next, and the error of the shape as a share of its root
mean square (what `mode_shapes.noise` of a structure file means), in common and to the one that stands out. These are the figures for
`measurement_noise` and `mode_shapes.noise` of a structure file.
"""

import argparse
import csv
import json
from pathlib import Path

import numpy as np

from simulate_accelerations import modes_of, read_tower


def read_arguments():
    here = Path(__file__).parent
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--records", type=Path, default=Path("records"), help="folder of simulate_accelerations.py, with truth.csv [records]")
    parser.add_argument("--identified", type=Path, default=Path("identified.ndjson"), help="[identified.ndjson]")
    parser.add_argument("--structure", type=Path, default=here / "tower.toml", help="structure file of the simulation [tower.toml beside this script]")
    return parser.parse_args()


def column(lines, key, modes):
    """One row a record and one column a mode of `key` in the measurements; nan where a mode is missing."""
    return np.array([[np.nan if x is None else x for x in line["measurements"][0].get(key) or [None] * modes] for line in lines])


def shape_errors(line, shapes):
    """Difference of each identified shape from the true one, both scaled to a root mean square of 1, as a list of arrays or None."""
    errors = []
    for identified, true in zip(line["measurements"][0].get("mode_shapes") or [], shapes.T):
        if identified is None:
            errors.append(np.full(len(true), np.nan))
            continue
        true, identified = true / np.sqrt(np.mean(true**2)), np.array(identified)
        errors.append(identified * (identified @ true) / (identified @ identified) - true)
    return errors


def main():
    settings = read_arguments()
    masses, springs, modes = read_tower(settings.structure)
    if not settings.identified.exists():
        raise SystemExit(f"{settings.identified} does not exist: run identify_and_post.py first")
    lines = {line["record"]: line for line in map(json.loads, settings.identified.read_text().splitlines())}
    with open(settings.records / "truth.csv", newline="") as file:
        truth = [row for row in csv.DictReader(file) if row["record"] in lines]
    lines = [lines[row["record"]] for row in truth]
    true_hz = np.array([[float(row[f"f{mode + 1}_hz"]) for mode in range(modes)] for row in truth])
    error = column(lines, "frequencies_hz", modes) / true_hz - 1
    stated = column(lines, "std_hz", modes) / true_hz
    with_std = np.isfinite(stated).any()
    # The scatter without the outermost values, as a standard deviation: 0.741 of the distance between the quartiles.
    print(f"{len(lines)} records, identification {np.mean([line['took_s'] for line in lines]):.2f} s each")
    print("| mode | missing | mean error, % | std of error, % | the same from quartiles, % | largest, % | stated std, % | error/stated, std | next record, correlation |")
    print("|---|---|---|---|---|---|---|---|---|")
    for mode in range(modes):
        e = error[:, mode]
        ok = np.isfinite(e)
        follows = ok[1:] & ok[:-1]
        quartiles = 0.741 * np.subtract(*np.percentile(e[ok], [75, 25]))
        rms = f"{100 * np.sqrt(np.mean(stated[ok, mode] ** 2)):.3f}" if with_std else "none"
        ratio = f"{np.std(e[ok] / stated[ok, mode]):.2f}" if with_std else "none"
        cells = [f"{np.mean(~ok):.2f}", f"{100 * e[ok].mean():.3f} ± {100 * e[ok].std(ddof=1) / np.sqrt(ok.sum()):.3f}", f"{100 * e[ok].std(ddof=1):.3f}",
                 f"{100 * quartiles:.3f}", f"{100 * abs(e[ok]).max():.3f}", rms, ratio, f"{np.corrcoef(e[1:][follows], e[:-1][follows])[0, 1]:.2f}"]
        print(f"| {mode + 1} | " + " | ".join(cells) + " |")
    whole = error[np.isfinite(error).all(axis=1)]
    print("correlation of the errors of the modes:")
    print(np.array2string(np.corrcoef(whole.T), precision=2, suppress_small=True))
    shapes = [modes_of(masses, springs, {name: float(row[name]) / springs[name][2] for name in springs})[1][:, :modes] for row in truth]
    if lines[0]["measurements"][0].get("mode_shapes"):
        differences = np.array([shape_errors(line, true) for line, true in zip(lines, shapes)])
        print("shape: standard deviation of one number as a share of the root mean square, and greatest mean error of a point")
        for mode in range(modes):
            d = differences[:, mode]
            print(f"mode {mode + 1}: {np.sqrt(np.nanmean(np.nanvar(d, axis=0))):.4f}, {abs(np.nanmean(d, axis=0)).max():.4f}")


if __name__ == "__main__":
    main()
