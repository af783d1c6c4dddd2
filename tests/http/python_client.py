"""The Python client against a running daemon ($CBCT_URL), with the scan in $SCAN_DIR (scan.json, projections.raw).

Run by test_python.sh, one class at a time. Where a connection has to break, a relay stands between that cuts it.
"""
import json
import os
import socket
import sys
import threading
import unittest
import warnings
from typing import Any, Dict, List, Tuple

import numpy as np
import requests

import cbctd

GRID = {"size": [31, 24, 15], "spacing_mm": [3, 4, 5]}
CENTRE = (12, -9, 10)  # mm, of the ball


class Relay:
    """Passes bytes on between client and daemon; cuts each of the first connections after so many bytes of one way."""

    def __init__(self, cuts: List[Tuple[str, int]]) -> None:
        self.cuts = cuts
        self.upstream = cbctd.Client().url.rpartition("//")[2].split(":")
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self.listener.getsockname()[1]}"
        self.lock = threading.Lock()
        threading.Thread(target=self.accept, daemon=True).start()

    def accept(self) -> None:
        while True:
            try:
                near, _ = self.listener.accept()
            except OSError:
                return
            far = socket.create_connection((self.upstream[0], int(self.upstream[1])))
            for source, target, way in ((near, far, "up"), (far, near, "down")):
                threading.Thread(target=self.copy, args=(source, target, way), daemon=True).start()

    def copy(self, source: socket.socket, target: socket.socket, way: str) -> None:
        passed = 0
        try:
            while data := source.recv(4096):
                passed += len(data)
                with self.lock:
                    cut = bool(self.cuts) and self.cuts[0][0] == way and passed >= self.cuts[0][1]
                    beyond = passed - self.cuts.pop(0)[1] if cut else 0
                target.sendall(data[: len(data) - beyond])
                if cut:
                    break
        except OSError:
            pass
        for end in (source, target):
            try:
                end.shutdown(socket.SHUT_RDWR)
            except OSError:
                pass

    def close(self) -> None:
        self.listener.close()


class Case(unittest.TestCase):
    def setUp(self) -> None:
        warnings.simplefilter("error", ResourceWarning)
        self.client = cbctd.Client(patience=20)
        self.addCleanup(self.client.close)
        directory = os.environ["SCAN_DIR"]
        with open(f"{directory}/scan.json", encoding="utf-8") as file:
            self.scan_json: Dict[str, Any] = json.load(file)
        detector, count = self.scan_json["detector"], self.scan_json["projections"]["count"]
        self.projections = np.fromfile(f"{directory}/projections.raw", "<f4").reshape(
            count, detector["rows"], detector["columns"]
        )
        orbit = self.scan_json["geometry"]
        self.geometry = cbctd.Geometry.circular(
            orbit["source_to_isocentre_mm"],
            orbit["source_to_detector_mm"],
            detector["pixel_mm"],
            first_angle_deg=orbit["first_angle_deg"],
            angle_step_deg=orbit["angle_step_deg"],
        )

    def relay(self, cuts: List[Tuple[str, int]]) -> cbctd.Client:
        relay = Relay(cuts)
        client = cbctd.Client(relay.url, patience=20)
        self.addCleanup(relay.close)
        self.addCleanup(client.close)
        self.addCleanup(lambda: self.assertEqual(relay.cuts, [], "each cut was made"))
        return client

    def uploaded(self) -> str:
        scan = str(self.client.create_scan(self.geometry, self.projections.shape)["id"])
        self.client.upload(scan, self.projections)
        return scan

    def finished(self, **recipe: Any) -> str:
        recipe.setdefault("grid", GRID)
        job = str(self.client.submit(self.uploaded(), recipe)["id"])
        self.client.wait(job, timeout=120)
        return job


class Scans(Case):
    def test_a_scan_from_announcement_to_removal(self) -> None:
        scan = self.client.create_scan(self.geometry, self.projections.shape, name="ball")
        self.assertEqual((scan["name"], scan["missing"], scan["derived"]["arc_deg"]), ("ball", [[0, 59]], 360))
        self.assertTrue(self.client.put_projection(scan["id"], 7, self.projections[7]))
        self.assertFalse(self.client.put_projection(scan["id"], 7, self.projections[7]))
        self.assertEqual(self.client.scan(scan["id"])["missing"], [[0, 6], [8, 59]])
        seen: List[Tuple[int, int]] = []
        self.client.upload(scan["id"], self.projections, progress=lambda done, total: seen.append((done, total)))
        self.assertEqual(self.client.scan(scan["id"])["missing"], [])
        self.assertEqual((seen[0], seen[-1]), ((1, 60), (60, 60)))
        np.testing.assert_array_equal(self.client.projection(scan["id"], 41), self.projections[41])
        self.assertIn(scan["id"], [other["id"] for other in self.client.scans()])
        self.client.delete_scan(scan["id"])
        with self.assertRaises(cbctd.Problem) as caught:
            self.client.scan(scan["id"])
        self.assertEqual(caught.exception.status, 404)

    def test_what_is_not_of_the_scan_is_not_sent(self) -> None:
        scan = self.client.create_scan(self.geometry, self.projections.shape)["id"]
        for wrong in (self.projections[1:], self.projections[:, 1:], self.projections.astype(complex)):
            with self.assertRaises(ValueError):
                self.client.upload(scan, wrong)
        with self.assertRaises(ValueError):
            self.client.put_projection(scan, 0, self.projections[0].T)
        counts = self.client.create_scan(
            self.geometry, self.projections.shape, dtype=np.uint16, quantity="intensity", air=60000
        )["id"]
        with self.assertRaises(ValueError):
            self.client.upload(counts, self.projections)
        # other types of numbers that a float32 holds, and memory that is not in order
        self.client.upload(scan, np.asfortranarray(self.projections.astype(np.float64)), compress=True)
        np.testing.assert_array_equal(self.client.projection(scan, 3), self.projections[3])

    def test_an_upload_that_breaks_goes_on_with_what_is_missing(self) -> None:
        scan = self.client.create_scan(self.geometry, self.projections.shape)["id"]
        # the first answers pass, then two requests break in their bodies
        client = self.relay([("up", 300000), ("up", 150000)])
        client.upload(scan, self.projections, connections=2)
        self.assertEqual(self.client.scan(scan)["missing"], [])
        np.testing.assert_array_equal(self.client.projection(scan, 59), self.projections[59])

    def test_flat_and_dark(self) -> None:
        shape = self.projections.shape
        scan = self.client.create_scan(self.geometry, shape, dtype=np.uint16, quantity="intensity")["id"]
        flat = np.full(shape[1:], 50000.0)
        self.assertTrue(self.client.put_flat(scan, flat))
        self.assertFalse(self.client.put_flat(scan, flat))
        self.assertTrue(self.client.put_dark(scan, np.full(shape[1:], 100)))
        self.client.delete_image(scan, "dark")
        self.assertTrue(self.client.put_dark(scan, np.full(shape[1:], 100)))
        document = self.client.scan(scan)
        self.assertEqual((document["flat"], document["dark"]), (True, True))

    def test_images_of_scatter(self) -> None:
        shape = self.projections.shape
        announced = {"kind": "images", "columns": 6, "rows": 4, "every": 25}
        scan = self.client.create_scan(
            self.geometry, shape, dtype=np.uint16, quantity="intensity", air=50000, scatter=announced
        )["id"]
        image = np.arange(24.0).reshape(4, 6)
        self.assertTrue(self.client.put_scatter(scan, 25, image))
        self.assertFalse(self.client.put_scatter(scan, 25, image))
        np.testing.assert_array_equal(self.client.scatter(scan, 25), image)
        self.assertEqual(self.client.scan(scan)["scatter"]["missing"], [0, 50, 59])
        with self.assertRaises(ValueError):
            self.client.put_scatter(scan, 0, np.zeros(shape[1:]))
        self.client.delete_scatter(scan, 25)
        self.assertTrue(self.client.put_scatter(scan, 25, image + 1))
        self.client.delete_scatter(scan)
        self.assertEqual(self.client.scan(scan)["scatter"]["received_count"], 0)

    def test_every_kind_of_geometry(self) -> None:
        angles = np.deg2rad(self.scan_json["geometry"]["angle_step_deg"] * np.arange(60))
        zero = np.zeros_like(angles)
        radial = np.stack([np.cos(angles), np.sin(angles), zero], axis=1)
        column = 4 * np.stack([-np.sin(angles), np.cos(angles), zero], axis=1)
        row = np.broadcast_to([0.0, 0.0, 4.0], radial.shape)
        source, pixel0 = 600 * radial, -400 * radial - 31.5 * column - 23.5 * row
        matrices = []
        for s, p, u, v in zip(source, pixel0, column, row):
            inverse = np.linalg.inv(np.stack([u, v, p - s], axis=1))
            matrices.append(np.column_stack([inverse, -inverse @ s]))
        for geometry in (
            cbctd.Geometry.views(source, pixel0, column, row, (4, 4)),
            cbctd.Geometry.matrices(matrices, (4, 4)),
            cbctd.Geometry.circular(600, 1000, (4, 4), angles_deg=np.rad2deg(angles)),
        ):
            derived = self.client.create_scan(geometry, self.projections.shape)["derived"]
            self.assertEqual((derived["arc_deg"], derived["direction"]), (360, "counter-clockwise"))
            self.assertAlmostEqual(derived["source_radius_mm"], 600, places=3)


class Jobs(Case):
    def test_refusals_carry_the_daemons_words(self) -> None:
        scan = self.uploaded()
        with self.assertRaises(cbctd.Problem) as caught:
            self.client.submit(scan, {"fdk": {}, "emit": [3]})
        problem = caught.exception
        self.assertEqual((problem.status, problem.pointer), (422, "/emit/0"))
        self.assertEqual(problem.type, "urn:cbctd:problem:impossible")
        self.assertTrue(problem.title and problem.detail and problem.request_id)
        self.assertIn(problem.detail, str(problem))

    def test_a_job_from_submission_to_removal(self) -> None:
        scan = self.uploaded()
        job = self.client.submit(scan, {"grid": GRID, "fdk": {}}, idempotency_key="once")
        self.assertEqual(self.client.submit(scan, {"grid": GRID, "fdk": {}}, idempotency_key="once")["id"], job["id"])
        self.assertEqual(self.client.wait(job["id"], timeout=120)["state"], "succeeded")
        self.assertEqual(self.client.job(job["id"])["state"], "succeeded")
        self.assertIn(job["id"], [other["id"] for other in self.client.jobs()])
        self.client.delete_job(job["id"])
        with self.assertRaises(cbctd.Problem):
            self.client.job(job["id"])

    def test_a_cancelled_job_is_no_success(self) -> None:
        recipe = {"grid": GRID, "sart": {"iterations": 100000, "subsets": "views"}}
        job = str(self.client.submit(self.uploaded(), recipe)["id"])
        with self.assertRaises(TimeoutError):
            self.client.wait(job, timeout=0.2)
        for event in self.client.events(job):
            if event.kind == "progress":
                break
        cancelled = self.client.cancel(job)
        self.assertEqual(cancelled and cancelled["state"], "cancelled")
        for ended in (lambda: self.client.wait(job), lambda: list(self.client.volumes(job))):
            with self.assertRaises(cbctd.JobFailed) as caught:
                ended()
            self.assertEqual(caught.exception.state, "cancelled")
        self.assertIsNone(self.client.cancel(job))

    def test_the_daemon(self) -> None:
        self.assertTrue(self.client.ready())
        self.assertEqual(self.client.devices()[0]["backend"], "cpu")
        self.assertEqual(self.client.quarantine(), [])
        with cbctd.Client("http://127.0.0.1:1") as nobody:
            self.assertFalse(nobody.ready())
            with self.assertRaises(cbctd.Broken):
                nobody.devices()


def wrong_values(row: Dict[str, Any]) -> List[Any]:
    """Values that the row of `cbct parameters` has no place for."""
    if row["type"] == "boolean":
        return [1, "true", [True]]
    if row["type"] == "choice":
        return ["none of them", 3, True, {}]
    if row["type"] in ("numbers", "integers"):
        good = [row["minimum"]] * row["count"]
        wrong = [good[:-1], good + good[:1], 7, "seven", good[:-1] + ["x"], good[:-1] + [10 * row["maximum"] + 1]]
        return wrong + ([good[:-1] + [row["minimum"] + 0.25]] if row["type"] == "integers" else [])
    wrong = [row["maximum"] * 1.5 + 1, row["minimum"] - 1, "many", [row["minimum"]], {"no": 1}, True]
    return wrong + ([row["minimum"] + 0.5] if row["type"] == "integer" else [])


def with_value(pointer: str, value: Any, document: Dict[str, Any]) -> Dict[str, Any]:
    """A copy of the document with this member."""
    document = json.loads(json.dumps(document))
    *path, name = pointer.split("/")[1:]
    holder = document
    for member in path:
        holder = holder.setdefault(member, {})
    holder[name] = value
    return document


class Checks(Case):
    def test_wrong_values_are_refused_with_the_daemons_words(self) -> None:
        """Each parameter of both documents, with values of the wrong type and out of range."""
        with open(os.environ["PARAMETERS"]) as file:
            parameters = json.load(file)
        documents = {"job": {"scan": self.uploaded(), "grid": dict(GRID)}, "scan": dict(self.scan_json)}
        documents["scan"]["projections"] = {**self.scan_json["projections"], "quantity": "intensity"}
        tried = 0
        for name, rows in parameters.items():
            for row in rows:
                for value in wrong_values(row):
                    document = with_value(row["pointer"], value, documents[name])
                    stage, _, member = row["pointer"].rpartition("/")
                    if member == "max_iterations":  # beside auto alone
                        document = with_value(stage + "/iterations", "auto", document)
                    with self.subTest(pointer=row["pointer"], value=value):
                        reply = requests.post(f"{self.client.url}/v1/{name}s", json=document)
                        said = reply.json()
                        with self.assertRaises(cbctd.Problem) as caught:
                            cbctd._check(name, document)
                        problem = caught.exception
                        self.assertEqual(
                            [problem.status, problem.type, problem.title, problem.detail, problem.pointer],
                            [reply.status_code, said["type"], said["title"], said["detail"], said.get("pointer", "")],
                        )
                        tried += 1
        self.assertGreater(tried, 150)

    def test_nothing_is_sent_of_a_wrong_value(self) -> None:
        with cbctd.Client("http://127.0.0.1:1") as nobody:
            with self.assertRaises(cbctd.Problem) as caught:
                nobody.submit("any", {"grid": {"size": [8, 0, 8], "spacing_mm": [1, 1, 1]}})
            self.assertEqual((caught.exception.pointer, caught.exception.request_id), ("/grid/size/1", ""))
            with self.assertRaises(cbctd.Problem):
                nobody.recon(self.projections, self.geometry, sart={"relaxation": 3})
            with self.assertRaises(cbctd.Problem):
                nobody.create_scan(self.geometry, self.projections.shape, quantity="counts")

    def test_what_the_daemon_takes_passes(self) -> None:
        cbctd._check("job", {"grid": GRID, "fdk": {}, "sart": {"iterations": "auto", "subsets": "views"}, "tv": {"alpha": "auto"}, "x": 1})
        cbctd._check("job", {"fdk": None, "cgls": {"iterations": 3.0, "stop": {"residual": 0}}, "emit": [1]})
        cbctd._check("scan", self.scan_json)


class Volumes(Case):
    def test_arrays_are_the_files_and_lie_the_same_way(self) -> None:
        job = self.finished(fdk={}, sart={"iterations": 2}, emit=["fdk", 1])
        names = [document["name"] for document in self.client.volume_list(job)]
        made = self.client.provenance(job, names[0])
        self.assertEqual((made["job"], made["volume"], made["unit"]), (job, names[0], "1/mm"))
        streamed = list(self.client.volumes(job))
        self.assertEqual([volume.name for volume in streamed], names)
        self.assertEqual(names, ["fdk", "iter-1", "final"])
        for volume in streamed:
            raw = np.frombuffer(self.client.volume_file(job, volume.name, format="raw"), "<f4").reshape(15, 24, 31)
            np.testing.assert_array_equal(volume.voxels, raw)
            again = self.client.volume(job, volume.name)
            np.testing.assert_array_equal(again.voxels, raw)
            self.assertEqual((again.stage, again.iteration), (volume.stage, volume.iteration))
            self.assertTrue(volume.voxels.flags.aligned and volume.voxels.flags.writeable)
            self.assertEqual((volume.spacing_mm, volume.origin_mm), ((3.0, 4.0, 5.0), (-45.0, -46.0, -35.0)))
        # the ball is where it was put: axes are z, y, x
        heavy = np.clip(streamed[-1].voxels - 0.01, 0, None)
        for axis, centre in enumerate(CENTRE):
            place = streamed[-1].origin_mm[axis] + streamed[-1].spacing_mm[axis] * np.arange(heavy.shape[2 - axis])
            weight = heavy.sum(axis=tuple(i for i in range(3) if i != 2 - axis))
            # half a voxel
            self.assertAlmostEqual(float((weight * place).sum() / weight.sum()), centre, delta=2.5)

    def test_arrays_lie_along_the_world_however_the_patient_does(self) -> None:
        plain = self.client.volume(self.finished(fdk={}))
        self.assertIsNone(plain.world_to_patient)
        tilt = [[0.8, -0.6, 0, 5], [0.6, 0.8, 0, -6], [0, 0, 1, 7], [0, 0, 0, 1]]
        for patient in ({"position": "HFDR"}, {"world_to_patient": np.ravel(tilt).tolist()}):
            volume = self.client.volume(self.finished(fdk={}, patient=patient))
            np.testing.assert_array_equal(volume.voxels, plain.voxels)
            np.testing.assert_allclose(volume.spacing_mm, plain.spacing_mm, rtol=1e-12)
            np.testing.assert_allclose(volume.origin_mm, plain.origin_mm, rtol=1e-12)
            right_side_down = [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
            expected = right_side_down if "position" in patient else tilt
            np.testing.assert_allclose(volume.world_to_patient, expected, atol=1e-12)
        for lies in ("FFP", np.array(tilt)):
            scan = self.client.create_scan(self.geometry, self.projections.shape, patient=lies)
            self.assertEqual(self.client.scan(scan["id"])["axes"]["z"], "I" if isinstance(lies, str) else "S")
            self.client.delete_scan(scan["id"])

    def test_types_scales_and_encodings(self) -> None:
        job = self.finished(fdk={})
        hu = self.client.volume(job, dtype=np.int16)
        mu = self.client.volume(job)
        self.assertEqual(hu.voxels.dtype, np.int16)
        # rounded, and what is far below air is held
        np.testing.assert_allclose(hu.voxels, np.clip(1000 * (mu.voxels / 0.0192 - 1), -32768, None), atol=0.51)
        half = self.client.volume(job, scale=2)
        self.assertEqual((half.voxels.shape, half.spacing_mm), ((8, 12, 16), (6.0, 8.0, 10.0)))
        self.assertEqual(half.origin_mm, (-43.5, -44.0, -32.5))
        self.assertAlmostEqual(float(half.voxels[0, 0, 0]), float(mu.voxels[:2, :2, :2].mean()), places=7)
        (packed,) = self.client.volumes(job, dtype=np.int16, compress=True)
        np.testing.assert_array_equal(packed.voxels, hu.voxels)
        self.assertEqual(list(self.client.volumes(job, after="final")), [])
        self.assertEqual(self.client.slice(job, axis="x", index=3, window=1000)[:8], b"\x89PNG\r\n\x1a\n")
        self.assertEqual(self.client.slice(job, normal="1,1,0", thickness=9, mode="max")[:8], b"\x89PNG\r\n\x1a\n")
        empty, tag = self.client.annotations(job)
        self.assertEqual(empty, {"measurements": [], "key_images": []})
        ruler = {"id": "1", "kind": "ruler", "points": [[0, 0, 0], [3, 4, 0]]}
        after = self.client.annotate(job, {"measurements": [ruler]}, tag)
        self.assertEqual(self.client.annotations(job), ({"measurements": [ruler], "key_images": []}, after))
        with self.assertRaises(cbctd.Problem) as stale:
            self.client.annotate(job, {}, tag)
        self.assertEqual(stale.exception.status, 412)
        self.assertEqual(self.client.volume_file(job, format="nrrd", type="int16")[:8], b"NRRD0004")
        with self.assertRaises(ValueError):
            self.client.volume(job, dtype=np.float64)
        with self.assertRaises(cbctd.Problem):
            self.client.volume(job, "iter-9")
        with self.assertRaises(cbctd.Problem):
            next(self.client.volumes(job, after="iter-9"))

    def test_a_stream_that_breaks_goes_on_behind_the_last_whole_volume(self) -> None:
        job = self.finished(fdk={}, sart={"iterations": 4}, emit=["fdk", 1, 2, 3])
        size = 31 * 24 * 15 * 4
        client = self.relay([("down", size + size // 2), ("down", 100), ("down", 2 * size + 9000)])
        got = list(client.volumes(job))
        self.assertEqual([volume.name for volume in got], ["fdk", "iter-1", "iter-2", "iter-3", "final"])
        for volume in got:
            np.testing.assert_array_equal(volume.voxels, self.client.volume(job, volume.name).voxels)


class Events(Case):
    def test_events_are_told_once_over_connections_that_break(self) -> None:
        job = self.finished(fdk={}, sart={"iterations": 3}, emit=["fdk"])
        whole = list(self.client.events(job))
        # a volume is told of when it is on the disk, and the iterations do not wait for that; the ball is taller than the grid
        kinds = [event.kind for event in whole if event.kind != "warning"]
        self.assertEqual(kinds[:2] + kinds[-3:], "state state volume state end".split())
        self.assertEqual(sorted(kinds[2:-3]), "progress progress progress volume".split())
        self.assertTrue(all(event.data["job"] == job for event in whole))
        client = self.relay([("down", 900), ("down", 500), ("down", 1200)])
        self.assertEqual(list(client.events(job)), whole)
        self.assertEqual(list(self.client.events(job, after=whole[3].id)), whole[4:])
        self.assertEqual(list(self.client.events(job, after=whole[-1].id)), [])
        with self.assertRaises(cbctd.Problem):
            next(self.client.events(job, after=10**9))

    def test_all_jobs(self) -> None:
        told = self.client.events(after="latest")
        first: List[cbctd.Event] = []
        # a generator asks when it is first read
        reader = threading.Thread(target=lambda: first.append(next(told)), daemon=True)
        reader.start()
        jobs = [self.finished(fdk={}) for _ in range(2)]
        reader.join(60)
        ends = [first[0].data["job"]] if first[0].kind == "end" else []
        while len(ends) < 2:
            event = next(told)
            if event.kind == "end":
                ends.append(event.data["job"])
        self.assertEqual(ends, jobs)
        told.close()


class Recon(Case):
    def test_one_call(self) -> None:
        before = ([s["id"] for s in self.client.scans()], [j["id"] for j in self.client.jobs()])
        kept: List[cbctd.Volume] = []
        final = cbctd.recon(
            self.projections, self.geometry, grid=GRID, sart={"iterations": 2}, tv={}, emit=["fdk", 1],
            on_volume=kept.append, url=self.client.url, priority="urgent",
        )
        self.assertEqual([volume.name for volume in kept], ["fdk", "iter-1", "final"])
        self.assertIs(kept[-1], final)
        self.assertEqual(final.voxels.shape, (15, 24, 31))
        self.assertAlmostEqual(float(final.voxels[9, 9, 19]), 0.02, delta=0.002)  # in the ball
        self.assertEqual(([s["id"] for s in self.client.scans()], [j["id"] for j in self.client.jobs()]), before)

    def test_intensities_and_what_is_kept(self) -> None:
        counts = np.clip(60000 * np.exp(-self.projections), 0, 65534).astype(np.uint16)
        volume = self.client.recon(
            counts, self.geometry, grid=GRID, quantity="intensity", air=60000, dtype=np.int16, progress=False,
            keep=True, name="kept",
        )
        self.assertEqual(volume.voxels.dtype, np.int16)
        self.assertAlmostEqual(float(volume.voxels[9, 9, 19]), 1000 * (0.02 / 0.0192 - 1), delta=100)
        scan = next(self.client.scans())
        self.assertEqual(scan["name"], "kept")
        flat = self.client.recon(
            counts, self.geometry, grid=GRID, quantity="intensity", dtype=np.int16, progress=False,
            flat=np.full(counts.shape[1:], 60000.0), dark=np.zeros(counts.shape[1:]),
        )
        self.assertLessEqual(int(np.abs(flat.voxels.astype(int) - volume.voxels).max()), 1)
        self.client.delete_job(next(self.client.jobs())["id"])
        self.client.delete_scan(scan["id"])

    def test_a_refusal_leaves_nothing(self) -> None:
        before = [s["id"] for s in self.client.scans()]
        with self.assertRaises(cbctd.Problem):
            self.client.recon(self.projections, self.geometry, fdk={"window": "round"}, progress=False)
        with self.assertRaises(ValueError):
            self.client.recon(self.projections[0], self.geometry)
        self.assertEqual([s["id"] for s in self.client.scans()], before)


class Busy(Case):
    """The daemon takes eight connections of an address."""

    def test_a_busy_daemon_is_asked_again(self) -> None:
        held: List[socket.socket] = []
        host, port = self.client.url.rpartition("//")[2].split(":")
        for _ in range(8):
            held.append(socket.create_connection((host, int(port))))
            held[-1].sendall(b"GET /livez HTTP/1.1\r\nHost: localhost\r\n\r\n")
            held[-1].recv(1000)
        with cbctd.Client(patience=0) as hasty:
            with self.assertRaises(cbctd.Problem) as caught:
                hasty.devices()
            self.assertEqual(caught.exception.status, 429)
        letting_go = threading.Timer(0.5, lambda: [s.close() for s in held])
        letting_go.start()
        self.assertEqual(self.client.devices()[0]["index"], 0)
        letting_go.join()



if __name__ == "__main__":
    unittest.main(argv=sys.argv, verbosity=2)
