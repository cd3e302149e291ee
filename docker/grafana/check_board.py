#!/usr/bin/env python3
"""Reads the board with the types of Grafana's Foundation SDK and writes it again: what Grafana does not know would be lost.

    pip install grafana-foundation-sdk
    python docker/grafana/check_board.py
"""

import json
import pathlib
import sys

from grafana_foundation_sdk.cog import plugins
from grafana_foundation_sdk.cog.encoder import JSONEncoder
from grafana_foundation_sdk.models.dashboard import Dashboard


def lost(given, again, path=""):
    """The paths of what is missing or different after reading and writing."""
    if isinstance(given, dict) and isinstance(again, dict):
        for key, value in given.items():
            yield from lost(value, again.get(key), f"{path}/{key}")
    elif isinstance(given, list) and isinstance(again, list) and len(given) == len(again):
        for index, pair in enumerate(zip(given, again)):
            yield from lost(*pair, f"{path}/{index}")
    elif given != again:
        yield path


plugins.register_default_plugins()
board = json.loads((pathlib.Path(__file__).parent / "modalwatch.json").read_text())
read = Dashboard.from_json(board)
missing = list(lost(board, json.loads(JSONEncoder().encode(read))))
print(f"{len(read.panels)} panels and rows; lost: {', '.join(missing) or 'nothing'}")
sys.exit(bool(missing))
