#!/usr/bin/env python3
"""Reads the history and the alarms of a structure from modalwatch into pandas and plots them.

The cells (`# %%`) can be run one by one in an editor that knows them (VS Code, Spyder), or all at once:

    history_to_pandas.py --structure tower --out tower.png
"""

# %% Settings
import argparse
import io
import os
from pathlib import Path
from urllib.parse import urljoin

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import pandas as pd
import requests

parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
parser.add_argument("--url", default="http://127.0.0.1:8080", help="[http://127.0.0.1:8080]")
parser.add_argument("--structure", default="tower", help="[tower]")
parser.add_argument("--from", dest="start", help="first time, such as 2026-01-05T00:00:00Z [all]")
parser.add_argument("--to", dest="end", help="end of the time, not part of it [all]")
parser.add_argument("--out", type=Path, default=Path("history.png"), help="[history.png]")
settings, _ = parser.parse_known_args()

session = requests.Session()
if "MODALWATCH_TOKEN" in os.environ:
    session.headers["Authorization"] = f"Bearer {os.environ['MODALWATCH_TOKEN']}"


def pages(path, **query):
    """The answers to a request below the structure, page by page; an error of the service is shown with its text. Of a JSON list, `next` is the
    cursor of the next page; of a CSV, the header Link has its address."""
    start = url = f"{settings.url}/v1/structures/{settings.structure}/{path}"
    while url:
        answer = session.get(url, params=query, timeout=60)
        if not answer.ok:
            raise SystemExit(f"{answer.url}: status {answer.status_code}: {answer.text}")
        yield answer
        if "json" in answer.headers["Content-Type"]:
            cursor = answer.json().get("next")
            url, query = cursor and start, {**query, "cursor": cursor}
        else:
            link = answer.links.get("next", {}).get("url")
            url, query = link and urljoin(start, link), {}


# %% History: one row for each batch and parameter
window = {key: value for key, value in (("from", settings.start), ("to", settings.end)) if value}
history = pd.concat([pd.read_csv(io.StringIO(page.text)) for page in pages("history", format="csv", limit=1000, **window)], ignore_index=True)
for column in ("measured_from", "measured_to"):
    history[column] = pd.to_datetime(history[column], utc=True)
if history.empty:
    raise SystemExit(f"structure {settings.structure} has no batches in this time")
print(history[["measured_from", "parameter", "mean", "mean_low", "mean_high", "probability_of_damage", "trust"]].tail(8).to_string(index=False))

# %% Undamaged level and change, in per cent: of each parameter, for the batches that were compared with a reference
compared = history[history["relative_change"].notna()]
change = compared.pivot_table(index="measured_from", columns="parameter", values="relative_change") * 100
print("\nchange against the undamaged reference, %, mean of each day:")
print(change.resample("1D").mean().round(2).tail(12).to_string())

# %% Alarms: one row for each episode
alarms = pd.json_normalize([alarm for page in pages("alarms") for alarm in page.json()["items"]])
if alarms.empty:
    print("\nno alarms")
else:
    if "parameter" not in alarms:
        alarms["parameter"] = None
    for column in ("opened_at", "ended_at"):
        alarms[column] = pd.to_datetime(alarms[column], utc=True)
    print("\nalarms, newest first (parameter NaN: several together, or the structure):")
    for _, alarm in alarms.iterrows():
        print(f"{alarm['alarm']}: {alarm['kind']}, {alarm['parameter']}, {alarm['state']} since {alarm['opened_at']:%Y-%m-%d %H:%M}: {alarm.get('sentence') if pd.notna(alarm.get('sentence')) else 'no sentence'}")

# %% Plot: mean with 90 % interval and probability of damage of each parameter; alarms of the parameter as bands
parameters = list(dict.fromkeys(history["parameter"].dropna()))
figure, axes = plt.subplots(len(parameters), 2, figsize=(10, 1.9 * len(parameters)), sharex=True, squeeze=False, layout="constrained")
last = history["measured_to"].max()
for (left, right), name in zip(axes, parameters):
    rows = history[history["parameter"] == name]
    times, unit = rows["measured_from"], rows["unit"].iloc[0]
    in_mega = unit == "N/m" and rows["mean"].median() >= 1e5
    values = rows[["mean", "mean_low", "mean_high", "threshold"]] / (1e6 if in_mega else 1)
    unit = "MN/m" if in_mega else unit
    left.vlines(times, values["mean_low"], values["mean_high"], linewidth=0.6)
    left.plot(times, values["mean"], ".", markersize=3)
    left.plot(times, values["threshold"], color="0.4", linewidth=0.8, drawstyle="steps-post")
    left.set_ylabel(f"{name}, {unit}" if isinstance(unit, str) else name)
    right.fill_between(times, 100 * rows["probability_of_damage_low"], 100 * rows["probability_of_damage_high"], alpha=0.25, linewidth=0)
    right.plot(times, 100 * rows["probability_of_damage"], ".", markersize=3)
    right.set_ylim(-3, 103)
    for _, alarm in alarms.iterrows() if not alarms.empty else []:
        if alarm.get("parameter") == name:
            for axis in (left, right):
                axis.axvspan(alarm["opened_at"], last if pd.isna(alarm["ended_at"]) else alarm["ended_at"], color="tab:red", alpha=0.12, linewidth=0)
axes[0, 0].set_title("mean with 90 % interval; grey: threshold", fontsize="medium")
axes[0, 1].set_title("probability of damage, %; red: alarm", fontsize="medium")
for axis in axes[-1]:
    axis.xaxis.set_major_formatter(matplotlib.dates.ConciseDateFormatter(axis.xaxis.get_major_locator()))
figure.savefig(settings.out, dpi=90)
print(f"\nplot: {settings.out}")
