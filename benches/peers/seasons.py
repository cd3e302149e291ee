"""Five published novelty indices on the seasons of real structures: python3 benches/peers/seasons.py [DATA].

DATA is the folder with z24-bridge, consoli-palace and sciri-tower (default: ../shared/data beside the project). Needs
numpy, pandas, scikit-learn, scipy and statsmodels. Prints tables in Markdown; the same data give the same tables.

All indices work on batches: the means of the identified frequencies of consecutive rows or of a calendar day. A mode
that is missing in a batch takes its conditional mean given the modes that are present, under the Gaussian of the
reference batches (fitted by expectation-maximisation, as reference batches can lack modes too). Everything is fitted to
the reference batches alone, and nothing adapts afterwards:

  Mahalanobis    squared Mahalanobis distance from the reference mean
  minor PCA      principal components of the standardised frequencies, without the first ones that explain 90 % of the
                 variance (at least one is kept); sum of the squared standardised scores of the rest
  cointegration  Johansen's procedure (constant term, one lagged difference); squared standardised residual of the
                 first cointegrating vector
  mixture        Gaussian mixture of 1 to 5 components, chosen by BIC; smallest squared Mahalanobis distance to one of
                 them. Passed over are mixtures with a component of fewer than p + 2 batches (p: number of modes), whose
                 covariance is close to singular
  VAR(1)         vector autoregression of order one; squared Mahalanobis distance of the one-step innovation. A batch
                 follows the one before it, however long the gap; the first follows the reference mean

The limit is the empirical quantile of the reference index at the wanted rate of false alarms. Where the reference has
too few batches for that (rate x batches < 1, which is the case in every table here) it is the quantile of a scaled
chi-square distribution with the mean and the variance of the reference index. An alarm is a batch above the limit.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
from scipy import stats
from sklearn.metrics import roc_auc_score
from sklearn.mixture import GaussianMixture
from statsmodels.tsa.vector_ar.vecm import coint_johansen

Array = np.ndarray
Index = Callable[[Array], Array]

RATE = 1 / 1000  # wanted false alarms per batch: one in 1000 batches
RATE_DAILY = 1 / 1095  # one in three years of daily batches
PRINCIPAL = 0.90  # share of the variance that the dropped principal components explain
LOSS = 0.03  # stiffness lost where the share of the strain energy is 1
FOUND_WITHIN, QUIET_BEFORE, PLACEMENTS = 10, 30, 20  # days, days, onsets
F1_LOSS_HZ, F1_LOSS_ROWS = 0.02982553, (24999, 36329)  # the semi-synthetic loss of the Consoli README, rows inclusive
WORLDS, WORLD_DAYS, FACTOR_SD, NOISE_SD, AUTOCORRELATION = 20, 1095, 0.025, 0.002, 0.9
Z24, CONSOLI = "z24-bridge/z24_frequencies.csv", "consoli-palace/consoli_frequencies.csv"
SCIRI = "sciri-tower/sciri_frequencies.csv"


def fill(batches: Array, mean: Array, covariance: Array) -> tuple[Array, Array]:
    """Missing modes by their conditional means; also the sum of their conditional covariances."""
    filled, spread = batches.copy(), np.zeros_like(covariance)
    for row in filled:
        gone = np.isnan(row)
        if gone.any():
            gain = np.linalg.solve(covariance[np.ix_(~gone, ~gone)], covariance[np.ix_(~gone, gone)])
            row[gone] = mean[gone] + (row[~gone] - mean[~gone]) @ gain
            spread[np.ix_(gone, gone)] += covariance[np.ix_(gone, gone)] - covariance[np.ix_(gone, ~gone)] @ gain
    return filled, spread


def gaussian(batches: Array) -> tuple[Array, Array]:
    """Mean and covariance by expectation-maximisation (batches without gaps: their mean and sample covariance)."""
    mean, covariance = np.nanmean(batches, axis=0), np.diag(np.nanvar(batches, axis=0))
    for _ in range(500):
        filled, spread = fill(batches, mean, covariance)
        before, mean = covariance, filled.mean(axis=0)
        covariance = ((filled - mean).T @ (filled - mean) + spread) / (len(filled) - 1)
        if np.abs(covariance - before).max() < 1e-9 * np.abs(covariance).max():
            break
    return mean, covariance


def squared_distance(deviations: Array, covariance: Array) -> Array:
    return np.einsum("ij,ij->i", deviations, np.linalg.solve(covariance, deviations.T).T)


# The five indices: each is fitted to the filled reference batches and gives the index of any filled batches.
def mahalanobis(reference: Array, mean: Array, covariance: Array) -> Index:
    return lambda batches: squared_distance(batches - mean, covariance)


def minor_components(reference: Array, mean: Array, covariance: Array) -> Index:
    deviation = np.sqrt(np.diag(covariance))
    variances, directions = np.linalg.eigh(covariance / np.outer(deviation, deviation))
    variances, directions = variances[::-1], directions[:, ::-1]
    explained = np.cumsum(variances) / variances.sum()
    dropped = min(int(np.searchsorted(explained, PRINCIPAL)) + 1, len(variances) - 1)
    weights = directions[:, dropped:] / np.sqrt(variances[dropped:])
    return lambda batches: np.square((batches - mean) / deviation @ weights).sum(axis=1)


def cointegration(reference: Array, mean: Array, covariance: Array) -> Index:
    vector = coint_johansen(reference, det_order=0, k_ar_diff=1).evec[:, 0]
    residual = reference @ vector
    return lambda batches: np.square((batches @ vector - residual.mean()) / residual.std(ddof=1))


def mixture(reference: Array, mean: Array, covariance: Array) -> Index:
    deviation = np.sqrt(np.diag(covariance))
    standardised, needed = (reference - mean) / deviation, reference.shape[1] + 2
    fits = [GaussianMixture(k, n_init=5, random_state=0, max_iter=1000).fit(standardised) for k in range(1, 6)]
    sound = [fit for fit in fits if (fit.weights_ * len(reference) >= needed).all()]
    best = min(sound, key=lambda fit: fit.bic(standardised))
    components = list(zip(best.means_, best.covariances_))

    def index(batches: Array) -> Array:
        scaled = (batches - mean) / deviation
        return np.min([squared_distance(scaled - centre, own) for centre, own in components], axis=0)

    return index


def autoregression(reference: Array, mean: Array, covariance: Array) -> Index:
    def lagged(batches: Array) -> Array:
        before = np.vstack([mean, batches[:-1]]) - mean
        return np.column_stack([np.ones(len(batches)), before])

    coefficients = np.linalg.lstsq(lagged(reference)[1:], reference[1:], rcond=None)[0]
    innovations = reference[1:] - lagged(reference)[1:] @ coefficients
    own = innovations.T @ innovations / (len(innovations) - coefficients.shape[0])
    return lambda batches: squared_distance(batches - lagged(batches) @ coefficients, own)


METHODS = {
    "Mahalanobis": mahalanobis,
    "minor PCA": minor_components,
    "cointegration": cointegration,
    "mixture": mixture,
    "VAR(1)": autoregression,
}


def limit_of(index: Array, rate: float) -> float:
    """The limit that a reference index exceeds at the wanted rate: see the head of the file."""
    if rate * len(index) >= 1:
        return float(np.quantile(index, 1 - rate))
    mean, variance = index.mean(), index.var(ddof=1)
    return float(variance / (2 * mean) * stats.chi2.ppf(1 - rate, 2 * mean**2 / variance))


class Watch:
    """One method, fitted to the first `reference` of the batches. Gives the index divided by its limit."""

    def __init__(self, method: Callable, batches: Array, reference: int, rate: float):
        self.mean, self.covariance = gaussian(batches[:reference])
        filled = fill(batches[:reference], self.mean, self.covariance)[0]
        self.index = method(filled, self.mean, self.covariance)
        self.limit = limit_of(self.index(filled), rate)
        assert np.isfinite(self.limit) and self.limit > 0

    def ratios(self, batches: Array) -> Array:
        ratios = self.index(fill(batches, self.mean, self.covariance)[0]) / self.limit
        assert np.isfinite(ratios).all()
        return ratios


def episodes(times: Array, longest_gap: int) -> int:
    """Groups of alarms, given by day or batch number, with at most `longest_gap` of them without alarm in between."""
    return int((np.diff(times) > longest_gap + 1).sum()) + 1 if len(times) else 0


def table(title: str, notes: list[str], head: list[str], rows: list[list]) -> None:
    """A Markdown table with aligned columns."""
    text = [[str(cell) for cell in row] for row in [head, *rows]]
    widths = [max(len(row[column]) for row in text) for column in range(len(head))]
    text.insert(1, ["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])])
    print(f"\n### {title}\n")
    print("\n".join(f"* {note}" for note in notes) + "\n")
    for row in text:
        cells = [row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:]))]
        print("| " + " | ".join(cells) + " |")


def batches_of(values: Array, rows: int) -> Array:
    """Means of consecutive rows without the missing values; rows that do not fill a last batch are left out."""
    whole = values[: len(values) // rows * rows]
    return np.nanmean(whole.reshape(-1, rows, values.shape[1]), axis=1)


def z24(path: Path) -> None:
    rows = pd.read_csv(path)
    rows = rows[~(rows.f3_hz >= rows.f4_hz)]
    batches = batches_of(rows.filter(regex=r"^f\d_hz$").to_numpy(), 24)
    damaged = batches_of(rows[["damaged"]].to_numpy(float), 24)[:, 0] > 0
    onset, out = int(damaged.argmax()), []
    for reference in (60, 84, 110):
        for name, method in METHODS.items():
            ratios = Watch(method, batches, reference, RATE).ratios(batches)
            false, found = np.flatnonzero(ratios[reference:onset] > 1), np.flatnonzero(ratios[onset:] > 1)
            before, first = "yes" if ratios[onset - 1] > 1 else "no", found[0] + 1 if len(found) else "none"
            area = f"{roc_auc_score(damaged[reference:], ratios[reference:]):.3f}"
            counts = [(ratios[:reference] > 1).sum(), onset - reference, len(false), episodes(false, 0)]
            out.append([name, reference, *counts, before, first, area])
    notes = [
        f"{len(batches)} batches of 24 rows without those with f3 >= f4; the last {damaged.sum()} hold damaged rows.",
        "reference: batches from the start that everything is fitted to; in reference: those above the limit.",
        "healthy: batches between reference and damage; false: those above the limit (wanted: one in 1000); episodes: "
        "runs of them; before: whether the last healthy batch is above the limit.",
        "damage at: first damaged batch above the limit (1: the very first); AUC: area under the ROC curve of healthy "
        "against damaged batches after the reference.",
    ]
    head = ["index", "reference", "in reference", "healthy", "false", "episodes", "before", "damage at", "AUC"]
    table("A. Z24 bridge", notes, head, out)


def daily(rows: pd.DataFrame) -> tuple[Array, Array, Array]:
    """Day numbers and daily means (at least 6 values for a mode, 3 modes for a day); also the day of each row."""
    stamps = pd.to_datetime(rows.time_local).where(rows.timestamp_suspect == 0).ffill()  # the order of rows is right
    day_of_row = (stamps.dt.normalize() - stamps.iloc[0].normalize()).dt.days
    groups = rows.filter(regex=r"^f\d_hz$").groupby(day_of_row)
    means = groups.mean().where(groups.count() >= 6)
    means = means[means.notna().sum(axis=1) >= 3]
    return means.index.to_numpy(), means.to_numpy(), day_of_row.to_numpy()


def consoli(path: Path, shares: Array) -> None:
    rows = pd.read_csv(path)
    days, healthy, day_of_row = daily(rows)
    reference, out = int((days < 365).sum()), []
    watches = {name: Watch(method, healthy, reference, RATE_DAILY) for name, method in METHODS.items()}
    for name, watch in watches.items():
        above = watch.ratios(healthy) > 1
        false = days[reference:][above[reference:]]
        out.append([name, above[:reference].sum(), len(false), episodes(false, 2)])
    notes = [
        f"{len(days)} days with a batch: {reference} of the first 365 days (reference), {len(days) - reference} after.",
        "in reference: reference days above the limit; false: later days above it (wanted: one in 1095); episodes: "
        "groups of those, merged where fewer than 3 days lie between.",
    ]
    table("B1. Consoli Palace, no loss", notes, ["index", "in reference", "false", "episodes"], out)
    rows.loc[slice(*F1_LOSS_ROWS), "f1_hz"] -= F1_LOSS_HZ
    consoli_f1(watches, days, healthy, daily(rows)[1], *day_of_row[list(F1_LOSS_ROWS)])
    consoli_stiffness(watches, days, healthy, shares)


def consoli_f1(watches: dict[str, Watch], days: Array, healthy: Array, lost: Array, begin: int, end: int) -> None:
    before, during, out = (days >= begin - QUIET_BEFORE) & (days < begin), (days >= begin) & (days <= end), []
    for name, watch in watches.items():
        both = [watch.ratios(batches) > 1 for batches in (lost, healthy)]
        alarms = [days[during & above] for above in both]
        delays = [own[0] - begin if len(own) else "none" for own in alarms]
        out.append([name, (before & both[1]).sum(), *delays, *map(len, alarms)])
    notes = [
        f"{F1_LOSS_HZ} Hz off f1 from day {begin} to {end} ({during.sum()} days with a batch). It touches one mode, "
        "which no loss of stiffness does.",
        f"before: days in alarm among the {QUIET_BEFORE} before the onset; delay: days from the onset to the first "
        "alarm; days: days in alarm during the loss.",
        "without: the same dates without the loss, which is what false alarms alone give.",
    ]
    head = ["index", "before", "delay", "delay without", "days", "days without"]
    table("B2. Consoli Palace, the semi-synthetic loss of f1", notes, head, out)


def consoli_stiffness(watches: dict[str, Watch], days: Array, healthy: Array, shares: Array) -> None:
    onsets, out = np.linspace(365 + QUIET_BEFORE, 730 - FOUND_WITHIN, PLACEMENTS).round().astype(int), []

    def within(dates: Array, first: int, length: int) -> bool:
        return bool(((dates >= first) & (dates < first + length)).any())

    for name, watch in watches.items():
        false = days[watch.ratios(healthy) > 1]
        quiet = [onset for onset in onsets if not within(false, onset - QUIET_BEFORE, QUIET_BEFORE)]
        found = 0
        for onset in quiet:
            factors = np.where((days >= onset)[:, None], np.sqrt(1 - LOSS * shares), 1)
            found += within(days[watch.ratios(healthy * factors) > 1], onset, FOUND_WITHIN)
        anyway = sum(within(false, onset, FOUND_WITHIN) for onset in quiet)
        share = f"{found / len(quiet):.2f}" if quiet else "-"
        out.append([name, PLACEMENTS - len(quiet), len(quiet), found, share, anyway])
    empty = sum(not within(days, onset, FOUND_WITHIN) for onset in onsets)
    notes = [
        f"Frequencies times sqrt(1 - {LOSS} w) from an onset on; {PLACEMENTS} onsets, evenly spaced from day "
        f"{onsets[0]} to {onsets[-1]}; {empty} of them have no batch in the {FOUND_WITHIN} days that follow.",
        f"w, shares of the strain energy: {', '.join(map('{:g}'.format, shares))} for modes 1 to {len(shares)}. They "
        "are an assumption (--loss-shares), not the result of a model.",
        f"before: onsets with an alarm in the {QUIET_BEFORE} days before; quiet: the others; found: quiet ones with an "
        f"alarm within {FOUND_WITHIN} days; share: found of quiet; anyway: quiet ones with an alarm on these days "
        "without a loss.",
    ]
    head = ["index", "before", "quiet", "found", "share", "anyway"]
    table(f"B3. Consoli Palace, loss of {100 * LOSS:g} % of stiffness", notes, head, out)


def sciri(path: Path) -> None:
    rows = pd.read_csv(path)
    values = rows.filter(regex=r"^f\d_hz$").to_numpy(copy=True)
    values[rows.filter(regex=r"^f\d_gapfilled$").to_numpy() == 1] = np.nan
    batches, reference, out = batches_of(values, 24), len(rows) * 3 // 4 // 24, []
    for name, method in METHODS.items():
        ratios = Watch(method, batches, reference, RATE).ratios(batches)
        false, largest = np.flatnonzero(ratios[reference:] > 1), f"{ratios[reference:].max():.2f}"
        out.append([name, (ratios[:reference] > 1).sum(), len(false), episodes(false, 0), largest])
    notes = [
        f"{len(batches)} batches of 24 rows (gap-filled values are missing): {reference} of the reference and "
        f"{len(batches) - reference} after.",
        "in reference: reference batches above the limit; false: later ones above it (wanted: one in 1000); episodes: "
        "runs of them; largest: largest later index, as a multiple of the limit.",
    ]
    table("C. Sciri Tower", notes, ["index", "in reference", "false", "episodes", "largest"], out)


def world(seed: int) -> Array:
    """Daily estimates of four frequencies that share one autoregressive factor."""
    random, factor = np.random.default_rng(seed), np.empty(WORLD_DAYS)
    shocks = FACTOR_SD * random.standard_normal(WORLD_DAYS)
    factor[0] = shocks[0]
    for day in range(1, WORLD_DAYS):
        factor[day] = AUTOCORRELATION * factor[day - 1] + np.sqrt(1 - AUTOCORRELATION**2) * shocks[day]
    noise = NOISE_SD * random.standard_normal((WORLD_DAYS, 4))
    return np.array([4.0, 5.2, 10.1, 10.8]) * (1 + factor[:, None] + noise)


def simulated() -> None:
    reference, out, worlds = 365, [], [world(seed) for seed in range(1, WORLDS + 1)]
    watched = WORLD_DAYS - reference
    for name, method in METHODS.items():
        ratios = [Watch(method, own, reference, RATE).ratios(own)[reference:] for own in worlds]
        alarms = [np.flatnonzero(own > 1) for own in ratios]
        counts, alarmed = [len(own) for own in alarms], sum(len(own) > 0 for own in alarms)
        until_first = sum(own[0] + 1 if len(own) else watched for own in alarms)
        run = f"{until_first / alarmed:.0f}" if alarmed else f"> {until_first}"
        out.append([name, f"{np.mean(counts):.2f}", max(counts), alarmed, run])
    notes = [
        f"{WORLDS} healthy worlds of {WORLD_DAYS} days, four frequencies: a common factor with standard deviation "
        f"{100 * FACTOR_SD:g} % (twice that in stiffness) and autocorrelation {AUTOCORRELATION}, and independent noise "
        f"of {100 * NOISE_SD:g} %. Reference: the first {reference} days.",
        f"false: healthy days above the limit per world (wanted: {RATE * watched:.2f}); most: largest number in a "
        "world; alarmed: worlds with one or more.",
        "run: days until the first false alarm (or the end of the world) of all worlds, divided by the worlds alarmed "
        f"(wanted: {1 / RATE:.0f}).",
    ]
    table("D. Simulated years", notes, ["index", "false", "most", "alarmed", "run"], out)


def main() -> None:
    parser = argparse.ArgumentParser(description="Five novelty indices over the seasons of real structures.")
    default = Path(__file__).resolve().parents[2] / "../shared/data"
    parser.add_argument("data", nargs="?", type=Path, default=default, help="folder of the data sets")
    parser.add_argument("--loss-shares", default="1,0.5,0.8,0.6,0.3", help="share of the strain energy for each mode")
    arguments = parser.parse_args()
    shares = np.array([float(share) for share in arguments.loss_shares.split(",")])
    if len(shares) != 5:
        parser.error("--loss-shares needs five numbers, one for each mode")
    absent = [name for name in (Z24, CONSOLI, SCIRI) if not (arguments.data / name).is_file()]
    if absent:
        print(f"No tables: {arguments.data} does not hold {', '.join(absent)}.")
        return
    z24(arguments.data / Z24)
    consoli(arguments.data / CONSOLI, shares)
    sciri(arguments.data / SCIRI)
    simulated()


main()
