"""Tests of the scripts in this folder: python3 -m unittest"""

import contextlib
import csv
import io
import json
import sys
import tempfile
import threading
import unittest
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from unittest import mock

import numpy as np

import identify_and_post
import simulate_accelerations

HERE = Path(__file__).parent
CHANNELS = "floor1,floor2,floor3,floor4"


def run(script, *arguments):
    """Exit status, standard output and standard error of a script."""
    out, err = io.StringIO(), io.StringIO()
    with mock.patch.object(sys, "argv", [script.__name__, *map(str, arguments)]), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = script.main()
    return status, out.getvalue(), err.getvalue()


class FakeService(BaseHTTPRequestHandler):
    """A service that knows the structure `tower`, is busy for the first batch once, and knows batches by their idempotency keys."""

    def log_message(self, *_):
        pass

    def answer(self, status, content, **headers):
        self.send_response(status)
        body = json.dumps(content).encode()
        for name, value in {"Content-Length": len(body), **{n.replace("_", "-"): v for n, v in headers.items()}}.items():
            self.send_header(name, str(value))
        self.end_headers()
        self.wfile.write(body)

    def do_GET(self):
        self.answer(200, {"definition": {"modes": 4, "mode_shapes": {"points": ["floor2", "floor4"], "noise": 0.01}}})

    def do_POST(self):
        body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        self.server.requests += 1
        if self.server.requests == 1:
            return self.answer(503, {"code": "busy"}, Retry_After=1)
        key = self.headers["Idempotency-Key"]
        before = self.server.batches.setdefault(key, body)
        if before != body:
            return self.answer(422, {"code": "idempotency_key_reused"})
        known = key in self.server.answered
        self.server.answered.add(key)
        self.answer(201, {"state": "assessed"}, **({"Idempotency_Replayed": "true"} if known else {}))


class Examples(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.folder = tempfile.TemporaryDirectory()
        cls.records = Path(cls.folder.name) / "records"
        run(simulate_accelerations, "--out", cls.records, "--healthy", 2, "--damaged", 1, "--duration-s", 300, "--seed", 5)
        cls.files = sorted(cls.records.glob("*.npz"))
        cls.reference = Path(cls.folder.name) / "reference_modes.json"
        status, _, errors = run(identify_and_post, "--learn", 2, "--modes", 4, "--channels", CHANNELS, "--reference", cls.reference, *cls.files)
        assert status == 0, errors

    @classmethod
    def tearDownClass(cls):
        cls.folder.cleanup()

    def identify(self, name, *more):
        """Identifies without a service; status, errors and the lines that were kept."""
        kept = Path(self.folder.name) / name
        status, _, errors = run(identify_and_post, "--no-post", "--channels", CHANNELS, "--points", CHANNELS, "--reference", self.reference, "--identified", kept, *more)
        return status, errors, [json.loads(line) for line in kept.read_text().splitlines()]

    def test_frequencies_and_shapes_are_those_of_the_tower(self):
        status, errors, lines = self.identify("a.ndjson", *self.files)
        self.assertEqual((status, errors), (0, ""))
        masses, springs, _ = simulate_accelerations.read_tower(HERE / "tower.toml")
        with open(self.records / "truth.csv", newline="") as file:
            for line, row in zip(lines, csv.DictReader(file), strict=True):
                _, shapes = simulate_accelerations.modes_of(masses, springs, {s: float(row[s]) / springs[s][2] for s in springs})
                found = line["measurements"][0]
                for mode in range(4):
                    hz = float(row[f"f{mode + 1}_hz"])
                    # A frequency from a record of length T has at best the relative standard deviation √(ζ/(4π f T)); SSI has up to twice that.
                    best = np.sqrt(0.01 / (4 * np.pi * hz * 300))
                    self.assertLess(abs(found["frequencies_hz"][mode] / hz - 1), 8 * best, (line["record"], mode))
                    self.assertGreater(identify_and_post.mac(np.array(found["mode_shapes"][mode]), shapes[:, mode]), 0.995)

    def test_the_same_seed_gives_the_same_record(self):
        again = Path(self.folder.name) / "again"
        run(simulate_accelerations, "--out", again, "--healthy", 1, "--damaged", 0, "--duration-s", 300, "--seed", 5)
        first, second = (np.load(folder / self.files[0].name)["acceleration"] for folder in (self.records, again))
        np.testing.assert_array_equal(first, second)

    def test_csv_mat_and_npy_give_what_npz_gives(self):
        _, _, expected = self.identify("npz.ndjson", self.files[0])
        values = np.load(self.files[0])["acceleration"]
        folder = Path(self.folder.name)
        times = np.arange(len(values)) / 50
        stem = self.files[0].stem
        np.savetxt(folder / f"{stem}.csv", np.column_stack([times, values]), fmt="%.9g", delimiter=",", header="time_s," + CHANNELS, comments="")
        np.save(folder / f"{stem}.npy", values)
        simulate_accelerations.io.savemat(folder / f"{stem}.mat", {"acceleration": values, "sampling_rate_hz": 50.0})
        for ending in ("csv", "npy", "mat"):
            _, errors, lines = self.identify(f"{ending}.ndjson", "--sampling-rate-hz", 50, folder / f"{stem}.{ending}")
            self.assertEqual(errors, "")
            np.testing.assert_allclose(lines[0]["measurements"][0]["frequencies_hz"], expected[0]["measurements"][0]["frequencies_hz"], rtol=1e-5)

    def test_a_mode_that_is_not_found_is_null_and_the_others_keep_their_places(self):
        reference = json.loads(self.reference.read_text())["modes"]
        wanted = [mode | {"shape": np.array(mode["shape"])} for mode in reference]
        settings = mock.Mock(max_shift=0.1, min_mac=0.8)
        found = identify_and_post.track(wanted, [wanted[3], wanted[0], wanted[1]], settings)
        self.assertEqual([mode and mode["hz"] for mode in found], [wanted[0]["hz"], wanted[1]["hz"], None, wanted[3]["hz"]])
        self.assertEqual(identify_and_post.track(wanted, [], settings), [None] * 4)

    def test_of_two_poles_of_one_mode_that_of_more_orders_is_kept_and_close_modes_of_other_shape_stay(self):
        mode = lambda hz, shape, share: {"hz": hz, "shape": np.array(shape), "share": share}
        kept = identify_and_post.without_doubles([mode(10.39, [1, 0.1], 0.58), mode(10.17, [1, 0], 1.0), mode(10.2, [0, 1], 0.6)])
        self.assertEqual(sorted(m["hz"] for m in kept), [10.17, 10.2])

    def test_a_busy_service_is_asked_again_and_a_second_run_posts_nothing_twice(self):
        server = HTTPServer(("127.0.0.1", 0), FakeService)
        server.requests, server.batches, server.answered = 0, {}, set()
        threading.Thread(target=server.serve_forever, daemon=True).start()
        common = ["--structure", "tower", "--url", f"http://127.0.0.1:{server.server_port}", "--channels", CHANNELS, "--reference", self.reference,
                  "--side-file", self.records / "conditions.csv", "--identified", Path(self.folder.name) / "posted.ndjson", *self.files]
        try:
            status, out, errors = run(identify_and_post, *common)
            self.assertEqual((status, errors, out.splitlines()[-1]), (0, "", "3 posted, 0 posted before, 0 refused"))
            self.assertEqual(server.requests, 4)
            _, out, _ = run(identify_and_post, *common)
            self.assertEqual(out.splitlines()[-1], "0 posted, 3 posted before, 0 refused")
        finally:
            server.shutdown()
            server.server_close()
        for batch in server.batches.values():
            measurement = batch["measurements"][0]
            self.assertEqual([len(shape) for shape in measurement["mode_shapes"]], [2] * 4)
            self.assertIsInstance(measurement["covariates"]["temperature_c"], float)

    def test_records_that_cannot_be_used_are_named_and_the_others_go_on(self):
        folder = Path(self.folder.name)
        values = np.load(self.files[0])["acceleration"]
        dead = values.copy()
        dead[:, 2] = 0.5
        np.savez(folder / "2026-02-01T00-00-00Z.npz", acceleration=dead, sampling_rate_hz=50.0)
        np.savez(folder / "monday.npz", acceleration=values, sampling_rate_hz=50.0)
        np.savez(folder / "local.npz", acceleration=values, sampling_rate_hz=50.0, started_at="2026-02-01T00:00:00")
        np.save(folder / "2026-02-02T00-00-00Z.npy", values)
        bad = ["2026-02-01T00-00-00Z.npz", "monday.npz", "local.npz", "2026-02-02T00-00-00Z.npy"]
        status, errors, lines = self.identify("bad.ndjson", *(folder / name for name in bad), self.files[1])
        self.assertEqual((status, len(lines)), (1, 1))
        for expected in ("floor3 is constant", "monday.npz: its start is unknown", "has no offset", "holds no sampling rate"):
            self.assertIn(expected, errors)


if __name__ == "__main__":
    unittest.main()
