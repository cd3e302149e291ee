#!/usr/bin/env python3
"""From acceleration records to modalwatch: identifies natural frequencies and mode shapes by pyOMA2, and posts them as measurements.

    identify_and_post.py --learn 10 --modes 4 records/*.npz          writes reference_modes.json from the first ten records
    identify_and_post.py --structure tower records/*.npz             identifies, follows the modes, posts one batch for each record

Identification: covariance-driven stochastic subspace identification (SSI-cov) for many model orders. A pole counts if it meets the hard
criteria (frequency range, damping, modal phase collinearity) and is stable from one order to the next (frequency, damping, MAC). Poles that are
close in frequency and shape form a mode, if at least --min-share of the orders have it. The frequency is the median of its poles. Of two modes
within 5 % in frequency and with a MAC above 0.9, the one that more orders have is kept.

Tracking: each reference mode gets the identified mode that is closest in frequency and shape, one to one, within --max-shift and --min-mac. A
reference mode that nothing matches is posted as null: missing, not zero.

What was identified is kept in identified.ndjson, one line a record, exactly as it is posted. A record that stands there is not identified
again, and its idempotency key makes the service count it once. A token is read from the environment variable MODALWATCH_TOKEN.
"""

import argparse
import csv
import json
import logging
import os
import re
import sys
import time
from datetime import datetime
from pathlib import Path

os.environ.setdefault("TQDM_DISABLE", "1")  # pyOMA2 shows progress bars otherwise

import numpy as np
import requests
from pyoma2.algorithms import SSI
from pyoma2.setup import SingleSetup
from scipy import io, optimize
from scipy.cluster import hierarchy
from urllib3.util.retry import Retry

logging.getLogger("pyoma2").setLevel(logging.WARNING)
DIGITS = 7  # significant digits that are posted


class Refused(Exception):
    """A record, a side file or an answer of the service that cannot be used; the text says why."""


# ---------------------------------------------------------------- the client


class Client:
    """The two requests that this script needs. Answers 429, 502 and 503 are repeated after the time in Retry-After."""

    def __init__(self, url, token, attempts=8):
        self.url, self.session = url.rstrip("/"), requests.Session()
        waits = Retry(total=attempts, backoff_factor=1, status_forcelist=[429, 502, 503], allowed_methods=None, respect_retry_after_header=True)
        for scheme in ("http://", "https://"):
            self.session.mount(scheme, requests.adapters.HTTPAdapter(max_retries=waits))
        if token:
            self.session.headers["Authorization"] = f"Bearer {token}"

    def request(self, method, path, **options):
        try:
            answer = self.session.request(method, self.url + path, timeout=60, **options)
        except requests.RequestException as error:
            raise Refused(f"{method} {self.url}{path}: {error}") from error
        if not answer.ok:
            raise Refused(f"{method} {path}: status {answer.status_code}: {answer.text}")
        return answer

    def structure(self, name):
        return self.request("GET", f"/v1/structures/{name}").json()["definition"]

    def post(self, structure, line):
        """Posts a batch; returns the answer and whether the service had it already."""
        batch = {"source": line["source"], "measurements": line["measurements"]}
        answer = self.request("POST", f"/v1/structures/{structure}/batches", json=batch, headers={"Idempotency-Key": line["idempotency_key"]})
        return answer.json(), answer.headers.get("Idempotency-Replayed") == "true"


# ---------------------------------------------------------------- records


def read_record(path, settings):
    """Accelerations (one row a sample, one column a channel), sampling rate in Hz, names of the channels, start or None."""
    kind, rate_hz, names, started_at = path.suffix.lower(), settings.sampling_rate_hz, None, None
    if kind == ".csv":
        table = np.genfromtxt(path, delimiter=",", names=True, dtype=float, deletechars="")
        names = list(table.dtype.names)
        values = np.column_stack([table[name] for name in names])
        if names[0] == settings.time_column:
            steps_s = np.diff(values[:, 0])
            if not steps_s.size or np.ptp(steps_s) > 0.01 * np.median(steps_s):
                raise Refused(f"{path}: column {names[0]} is not evenly spaced; resample the record first")
            rate_hz, names, values = 1 / np.mean(steps_s), names[1:], values[:, 1:]
    elif kind == ".npy":
        values = np.load(path)
    elif kind in (".npz", ".mat"):
        content = np.load(path) if kind == ".npz" else io.loadmat(path, squeeze_me=True)
        if settings.variable not in content:
            raise Refused(f"{path}: has no variable {settings.variable}, but {', '.join(k for k in content if k[0] != '_')}; give --variable")
        values = np.asarray(content[settings.variable])
        rate_hz = float(content["sampling_rate_hz"]) if "sampling_rate_hz" in content else rate_hz
        started_at = str(content["started_at"]) if "started_at" in content else None
    else:
        raise Refused(f"{path}: is neither .csv, .npy, .npz nor .mat")
    if rate_hz is None:
        raise Refused(f"{path}: holds no sampling rate; give --sampling-rate-hz")
    if values.ndim != 2 or values.shape[0] < values.shape[1]:
        raise Refused(f"{path}: has the shape {values.shape}; expected is one row for each sample and one column for each channel")
    names = settings.channels or names or [f"channel{i + 1}" for i in range(values.shape[1])]
    if len(names) != values.shape[1]:
        raise Refused(f"{path}: has {values.shape[1]} channels, but {len(names)} names of channels are given")
    unusable = [n for n, column in zip(names, values.T) if not np.isfinite(column).all() or np.ptp(column) == 0]
    if unusable:
        raise Refused(f"{path}: channel {', '.join(unusable)} is constant or has gaps")
    return values.astype(float), rate_hz, names, started_at


def read_side_file(path):
    """Rows of a CSV with the column `record` (name of the file); the other columns are `measured_at` and covariates. Empty cells are left out."""
    if path is None:
        return {}
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    if not rows or "record" not in rows[0]:
        raise Refused(f"{path}: needs a column `record` with the names of the record files")
    return {row.pop("record"): {name: cell for name, cell in row.items() if cell} for row in rows}


def measured_at(path, started_at, beside):
    """Start of the record with its offset: from the side file, the record itself, or a name such as 2026-01-05T00-00-00Z.npz."""
    named = re.search(r"(\d{4}-\d\d-\d\dT\d\d)-?(\d\d)-?(\d\d)Z", path.name)
    text = beside.get("measured_at") or started_at or (named and "{}:{}:{}Z".format(*named.groups()))
    if not text:
        raise Refused(f"{path}: its start is unknown: give a column measured_at in the side file, or a name such as 2026-01-05T00-00-00Z{path.suffix}")
    try:
        moment = datetime.fromisoformat(text)
    except ValueError as error:
        raise Refused(f"{path}: start {text!r} is not a time such as 2026-01-05T00:00:00Z") from error
    if moment.tzinfo is None:
        raise Refused(f"{path}: start {text!r} has no offset to UTC; write Z or +01:00 behind it")
    return moment.isoformat()


def number_or_text(cell):
    try:
        return float(cell)
    except ValueError:
        return cell


# ---------------------------------------------------------------- identification


def mac(a, b):
    """Modal assurance criterion of two shapes, 0 to 1."""
    return abs(np.vdot(a, b)) ** 2 / (np.vdot(a, a).real * np.vdot(b, b).real)


def distances(a, b):
    """|Δf|/f + 1 − MAC of each mode of `a` from each of `b`."""
    return np.array([[abs(x["hz"] - y["hz"]) / max(x["hz"], y["hz"]) + 1 - mac(x["shape"], y["shape"]) for y in b] for x in a])


def clusters(modes, closer_than):
    """Groups of modes that are closer to one another than `closer_than` (average linkage)."""
    if len(modes) < 2:
        return [modes] if modes else []
    apart = distances(modes, modes)
    tree = hierarchy.average(apart[np.triu_indices(len(modes), 1)])
    labels = hierarchy.fcluster(tree, closer_than, "distance")
    return [[mode for mode, label in zip(modes, labels) if label == group] for group in np.unique(labels)]


def real_shape(shape):
    """The shape turned to the real axis, with norm 1. What is imaginary then is noise, or damping that is not proportional."""
    turned = (shape * np.exp(-0.5j * np.angle(np.sum(shape**2)))).real
    return turned / np.linalg.norm(turned) * np.sign(turned[np.argmax(abs(turned))])


def identify(values, rate_hz, settings):
    """Modes of one record, ascending: frequency and its standard deviation (hz, std_hz), damping, shape, and share of the orders that have it."""
    hard = {"xi_max": settings.max_damping, "mpc_lim": settings.min_mpc, "mpd_lim": None, "CoV_max": None}
    soft = {"err_fn": settings.stable_frequency, "err_xi": settings.stable_damping, "err_phi": 1 - settings.stable_mac}
    ssi = SSI(name="ssi", br=settings.block_rows, ordmin=settings.min_order, ordmax=settings.max_order, step=2, sc=soft, hc=hard,
              calc_unc=settings.uncertainty, nb=settings.blocks)
    setup = SingleSetup(values - values.mean(axis=0), fs=rate_hz)
    setup.add_algorithms(ssi)
    setup.run_by_name("ssi")
    found = ssi.result
    low, high = settings.frequency_range_hz or (0.02 * rate_hz / 2, 0.9 * rate_hz / 2)
    with np.errstate(invalid="ignore"):
        kept = np.argwhere((found.Lab == 1) & (found.Fn_poles >= low) & (found.Fn_poles <= high) & (found.Xi_poles > 0))
    std = (lambda row, order: found.Fn_poles_std[row, order]) if settings.uncertainty else (lambda row, order: np.nan)
    poles = [{"hz": found.Fn_poles[i, o], "std_hz": std(i, o), "damping": found.Xi_poles[i, o], "order": o, "shape": found.Phi_poles[i, o]} for i, o in kept]
    orders = len(range(settings.min_order, settings.max_order + 1, 2))
    modes = []
    for cluster in clusters(poles, settings.same_mode):
        share = len({pole["order"] for pole in cluster}) / orders
        if share >= settings.min_share:
            middle = {key: float(np.median([pole[key] for pole in cluster])) for key in ("hz", "std_hz", "damping")}
            typical = min(cluster, key=lambda pole: abs(pole["hz"] - middle["hz"]))
            modes.append(middle | {"shape": real_shape(typical["shape"]), "share": share})
    return sorted(without_doubles(modes), key=lambda mode: mode["hz"])


def without_doubles(modes, closer_than=0.05, mac_above=0.9):
    """One of several modes of almost the same frequency and shape: the one that most orders have. The others are poles that a high order adds
    beside a true one. Modes that are truly close have different shapes."""
    kept = []
    for mode in sorted(modes, key=lambda mode: -mode["share"]):
        if not any(abs(mode["hz"] / other["hz"] - 1) < closer_than and mac(mode["shape"], other["shape"]) > mac_above for other in kept):
            kept.append(mode)
    return kept


def track(reference, modes, settings):
    """For each reference mode the identified one that belongs to it, or None. Pairs have the smallest sum of distances."""
    if not modes:
        return [None] * len(reference)
    cost = distances(reference, modes)
    for i, wanted in enumerate(reference):
        for j, mode in enumerate(modes):
            if abs(mode["hz"] / wanted["hz"] - 1) > settings.max_shift or mac(mode["shape"], wanted["shape"]) < settings.min_mac:
                cost[i, j] = 1e3  # larger than any sum of distances: chosen only where nothing fits, and then dropped
    pairs = dict(zip(*optimize.linear_sum_assignment(cost)))
    return [modes[pairs[i]] if i in pairs and cost[i, pairs[i]] < 1e3 else None for i in range(len(reference))]


def learn_reference(paths, settings):
    """The lowest modes that at least 70 % of the first records have, as reference for tracking."""
    every = []
    for path in paths[: settings.learn]:
        values, rate_hz, names, _ = read_record(path, settings)
        every.append(identify(values, rate_hz, settings))
        print(f"{path.name}: " + ", ".join(f"{mode['hz']:.3f}" for mode in every[-1]) + " Hz")
    groups = clusters([mode for modes in every for mode in modes], 0.1)
    lasting = [group for group in groups if len(group) >= 0.7 * len(every)]
    reference = []
    for group in sorted(lasting, key=lambda group: np.median([mode["hz"] for mode in group]))[: settings.modes]:
        shapes = [mode["shape"] * np.sign(np.dot(mode["shape"], group[0]["shape"])) for mode in group]
        reference.append({"hz": float(np.median([mode["hz"] for mode in group])), "shape": [float(x) for x in np.mean(shapes, axis=0)], "records": len(group)})
    if len(reference) < settings.modes:
        raise Refused(f"only {len(reference)} modes are in 70 % of {len(every)} records, --modes asks for {settings.modes}: "
                      "look at the frequencies above; longer records, --block-rows or --max-order may help")
    settings.reference.write_text(json.dumps({"channels": names, "modes": reference}, indent=1) + "\n")
    print(f"{settings.reference}: " + ", ".join(f"{mode['hz']:.4g} Hz in {mode['records']} of {len(every)}" for mode in reference))
    print("Compare them with the frequencies of your structure file: mode 1 here must be mode 1 there.")


# ---------------------------------------------------------------- from a record to a line of identified.ndjson


def rounded(x):
    return float(f"{x:.{DIGITS}g}")


def line_of(path, side, reference, points, settings):
    """Identifies a record; the batch as it will be posted, with what else was found for people."""
    values, rate_hz, names, started_at = read_record(path, settings)
    if names != reference["channels"]:
        raise Refused(f"{path}: its channels are {names}, those of {settings.reference} {reference['channels']}")
    beside = side.get(path.name, {})
    begun = time.perf_counter()
    wanted = [mode | {"shape": np.array(mode["shape"])} for mode in reference["modes"]]
    modes = track(wanted, identify(values, rate_hz, settings), settings)
    took_s = time.perf_counter() - begun
    measurement = {"measured_at": measured_at(path, started_at, beside), "frequencies_hz": [mode and rounded(mode["hz"]) for mode in modes]}
    if settings.uncertainty:
        measurement["std_hz"] = [mode and rounded(mode["std_hz"]) for mode in modes]
    if points:
        chosen = [names.index(point) for point in points]
        measurement["mode_shapes"] = [mode and [rounded(x) for x in mode["shape"][chosen]] for mode in modes]
    covariates = {name: number_or_text(cell) for name, cell in beside.items() if name != "measured_at"}
    if covariates:
        measurement["covariates"] = covariates
    return {"record": path.name, "source": settings.source, "idempotency_key": f"{settings.source}/{path.name}", "measurements": [measurement],
            "damping": [mode and rounded(mode["damping"]) for mode in modes], "took_s": round(took_s, 3)}


def identify_and_post(paths, settings):
    """Identifies what is new, posts everything; the number of records that were refused."""
    if not settings.reference.exists():
        raise Refused(f"{settings.reference} does not exist: make it first from healthy records by --learn 10 --modes N")
    reference = json.loads(settings.reference.read_text())
    client = None if settings.no_post else Client(settings.url, os.environ.get("MODALWATCH_TOKEN"))
    points = settings.points
    if client:
        definition = client.structure(settings.structure)
        points = definition.get("mode_shapes", {}).get("points", [])
        if definition["modes"] != len(reference["modes"]):
            raise Refused(f"structure {settings.structure} has {definition['modes']} modes, {settings.reference} {len(reference['modes'])}")
    unknown = [point for point in points if point not in reference["channels"]]
    if unknown:
        raise Refused(f"point {', '.join(unknown)} of mode_shapes is no channel; the channels are {', '.join(reference['channels'])}; give --channels")
    side = read_side_file(settings.side_file)
    kept = settings.identified.read_text().splitlines() if settings.identified.exists() else []
    known = {line["record"]: line for line in map(json.loads, kept)}
    new, replayed, refused = 0, 0, 0
    with open(settings.identified, "a") as file:
        for path in paths:
            try:
                line = known.get(path.name)
                if line is None:
                    line = line_of(path, side, reference, points, settings)
                    print(json.dumps(line), file=file, flush=True)
                answer, before = client.post(settings.structure, line) if client else ({"state": "not posted"}, False)
            except Refused as problem:
                print(problem, file=sys.stderr)
                refused += 1
                continue
            new, replayed = new + (not before), replayed + before
            hz = ", ".join("missing" if f is None else f"{f:.4f}" for f in line["measurements"][0]["frequencies_hz"])
            print(f"{path.name}: {hz} Hz; {'posted before' if before else answer['state']}")
    print(f"{new} {'identified' if settings.no_post else 'posted'}, {replayed} posted before, {refused} refused")
    return refused


def read_arguments():
    names = lambda text: [name.strip() for name in text.split(",")]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("records", nargs="+", type=Path, help="record files: .csv, .npy, .npz, .mat")
    files = parser.add_argument_group("records and service")
    files.add_argument("--structure", help="id of the structure in the service")
    files.add_argument("--url", default="http://127.0.0.1:8080", help="[http://127.0.0.1:8080]")
    files.add_argument("--source", default="oma", help="name of the source of the batches [oma]")
    files.add_argument("--side-file", type=Path, help="CSV with the columns record, measured_at (optional) and covariates")
    files.add_argument("--reference", type=Path, default=Path("reference_modes.json"), help="reference modes [reference_modes.json]")
    files.add_argument("--identified", type=Path, default=Path("identified.ndjson"), help="what was identified [identified.ndjson]")
    files.add_argument("--learn", type=int, metavar="N", help="make the reference modes from the first N records and end")
    files.add_argument("--modes", type=int, help="number of modes, with --learn")
    files.add_argument("--no-post", action="store_true", help="identify only")
    files.add_argument("--channels", type=names, help="names of the channels, separated by commas, as the masses or nodes that carry the sensors")
    files.add_argument("--points", type=names, default=[], help="with --no-post: channels whose shapes are kept (otherwise mode_shapes.points of the structure)")
    files.add_argument("--variable", default="acceleration", help="name of the array in .npz and .mat [acceleration]")
    files.add_argument("--sampling-rate-hz", type=float, help="if the record does not hold it as sampling_rate_hz or as a column of times")
    files.add_argument("--time-column", default="time_s", help="name of the first column of a CSV that holds seconds [time_s]")
    ssi = parser.add_argument_group("identification")
    ssi.add_argument("--block-rows", type=int, default=30, help="block rows of the Hankel matrix: some periods of mode 1 in samples [30]")
    ssi.add_argument("--min-order", type=int, default=8, help="lowest model order [8]")
    ssi.add_argument("--max-order", type=int, default=30, help="highest model order [30]")
    ssi.add_argument("--frequency-range-hz", type=float, nargs=2, metavar=("LOW", "HIGH"), help="[2 %% to 90 %% of half the sampling rate]")
    ssi.add_argument("--max-damping", type=float, default=0.05, help="[0.05]")
    ssi.add_argument("--min-mpc", type=float, default=0.8, help="modal phase collinearity [0.8]")
    ssi.add_argument("--stable-frequency", type=float, default=0.01, help="largest relative change from order to order [0.01]")
    ssi.add_argument("--stable-damping", type=float, default=0.2, help="the same of the damping [0.2]")
    ssi.add_argument("--stable-mac", type=float, default=0.98, help="smallest MAC from order to order [0.98]")
    ssi.add_argument("--same-mode", type=float, default=0.03, help="largest |Δf|/f + 1 − MAC of poles of one mode [0.03]")
    ssi.add_argument("--min-share", type=float, default=0.5, help="share of the orders that must have the mode [0.5]")
    ssi.add_argument("--uncertainty", action="store_true", help="post the standard deviations of pyOMA2 as std_hz; see docs/accelerometers.md for why not")
    ssi.add_argument("--blocks", type=int, default=50, help="segments of the record for the uncertainty [50]")
    ssi.add_argument("--max-shift", type=float, default=0.1, help="largest relative distance from the reference frequency [0.1]")
    ssi.add_argument("--min-mac", type=float, default=0.8, help="smallest MAC with the reference shape [0.8]")
    settings = parser.parse_args()
    if settings.learn and not settings.modes:
        parser.error("--learn needs --modes: the number of modes of the structure file")
    if not (settings.learn or settings.no_post or settings.structure):
        parser.error("--structure is missing: the id of the structure in the service (or --no-post)")
    return settings


def main():
    settings = read_arguments()
    paths = sorted(settings.records, key=lambda path: path.name)
    try:
        if settings.learn:
            learn_reference(paths, settings)
            return 0
        return 1 if identify_and_post(paths, settings) else 0
    except Refused as problem:
        print(problem, file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main())
