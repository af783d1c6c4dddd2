"""Client of cbctd: cone-beam projections go in as NumPy arrays, volumes come out.

In one call::

    import cbctd
    geometry = cbctd.Geometry.circular(620, 1100, pixel_mm=(0.8, 0.8), angles_deg=np.arange(0, 360, 3.6))
    volume = cbctd.recon(projections, geometry, sart={"iterations": 10}, tv={})
    volume.voxels            # float32 [z][y][x], 1/mm

Or step by step, while the arm still turns::

    with cbctd.Client("http://cart:2228") as client:
        scan = client.create_scan(geometry, projections.shape)
        job = client.submit(scan["id"], {"fdk": {}, "sart": {}, "emit": ["fdk", 1, 5]})
        client.upload(scan["id"], projections)
        for volume in client.volumes(job["id"]):
            show(volume.voxels)

Everywhere: projections are ``[view][row][column]``, volumes ``[z][y][x]``; lengths are mm, angles degrees; the world's
origin is the isocentre, z the rotation axis. Voxels are linear attenuation in 1/mm (float32) or Hounsfield units
(int16). What the daemon refuses is raised as `Problem`, with its words; a parameter out of its range before it is sent.
Connections that break are taken up again where they broke, busy daemons (429, 503) are asked again after the pause that
they ask for.

A `Client` may be used from several threads.
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
import socket
import threading
import time
import uuid
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Callable, Dict, Iterator, List, Mapping, NamedTuple, Optional, Sequence, Tuple, Union

import numpy as np
import numpy.typing as npt
import requests
import requests.adapters

__all__ = [
    "Broken",
    "CalibrationFailed",
    "Client",
    "Error",
    "Event",
    "Geometry",
    "JobFailed",
    "Problem",
    "Volume",
    "recon",
]

Array = npt.NDArray[Any]
Document = Dict[str, Any]
Progress = Callable[[int, int], None]

_FLOAT32: np.dtype[Any] = np.dtype("<f4")
_UINT16: np.dtype[Any] = np.dtype("<u2")
_INT16: np.dtype[Any] = np.dtype("<i2")
# What breaks when a connection does.
_BREAKS = (
    requests.exceptions.ConnectionError,
    requests.exceptions.Timeout,
    requests.exceptions.ChunkedEncodingError,
    requests.exceptions.ContentDecodingError,
)
_HEARTBEAT = 10.0  # s: the longest that a living daemon keeps silent in events
_RUN_BYTES = 16 << 20  # of one request of an upload: the daemon syncs its disk once for each

# The table of `cbct parameters`: parameters.py writes it.
_PARAMETERS: Dict[str, Dict[str, Document]] = {
    "job": {
        "/grid/size": {"type": "integers", "minimum": 1, "maximum": 8192, "count": 3, "unit": "voxels"},
        "/grid/spacing_mm": {"type": "numbers", "minimum": 1e-06, "maximum": 1000, "count": 3},
        "/grid/origin_mm": {"type": "numbers", "minimum": -1000000, "maximum": 1000000, "count": 3},
        "/fdk/window": {"type": "choice", "choices": ["ram-lak", "shepp-logan", "cosine", "hamming", "hann"]},
        "/fdk/cutoff": {"type": "number", "minimum": 0.001, "maximum": 1},
        "/fdk/truncation": {"type": "choice", "choices": ["off", "auto"]},
        "/sart/iterations": {"type": "integer", "minimum": 1, "maximum": 100000, "word": "auto"},
        "/cgls/iterations": {"type": "integer", "minimum": 1, "maximum": 100000, "word": "auto"},
        "/fista/iterations": {"type": "integer", "minimum": 1, "maximum": 100000, "word": "auto"},
        "/sart/max_iterations": {"type": "integer", "minimum": 1, "maximum": 100000},
        "/cgls/max_iterations": {"type": "integer", "minimum": 1, "maximum": 100000},
        "/fista/max_iterations": {"type": "integer", "minimum": 1, "maximum": 100000},
        "/sart/relaxation": {"type": "number", "minimum": 1e-06, "maximum": 2},
        "/sart/subsets": {"type": "integer", "minimum": 1, "maximum": 20000, "word": "views"},
        "/sart/momentum": {"type": "boolean"},
        "/fista/weights": {"type": "choice", "choices": ["even", "counts", "noise"]},
        "/sart/nonnegative": {"type": "boolean"},
        "/cgls/nonnegative": {"type": "boolean"},
        "/fista/nonnegative": {"type": "boolean"},
        "/sart/stop/residual": {"type": "number", "minimum": 0, "maximum": 1000000},
        "/cgls/stop/residual": {"type": "number", "minimum": 0, "maximum": 1000000},
        "/fista/stop/residual": {"type": "number", "minimum": 0, "maximum": 1000000},
        "/sart/stop/change": {"type": "number", "minimum": 0, "maximum": 1000000},
        "/cgls/stop/change": {"type": "number", "minimum": 0, "maximum": 1000000},
        "/fista/stop/change": {"type": "number", "minimum": 0, "maximum": 1000000},
        "/tv/method": {"type": "choice", "choices": ["gradient", "proximal", "tgv"]},
        "/tv/alpha": {"type": "number", "minimum": 0, "maximum": 1000000000, "word": "auto"},
        "/tv/strength": {"type": "choice", "choices": ["light", "medium", "strong"]},
        "/tv/step": {"type": "number", "minimum": 1e-09, "maximum": 1000000000},
        "/tv/iterations": {"type": "integer", "minimum": 1, "maximum": 100000},
        "/tv/unit": {"type": "number", "minimum": 1e-12, "maximum": 1000000000000},
        "/tv/after": {"type": "choice", "choices": ["sart", "fdk+sart"]},
        "/metal/threshold_hu": {"type": "number", "minimum": 500, "maximum": 1000000},
        "/refine/geometry": {"type": "boolean"},
        "/refine/motion": {"type": "boolean"},
        "/projector": {"type": "choice", "choices": ["interpolating", "matched"]},
        "/binning": {"type": "integer", "minimum": 1, "maximum": 8, "word": "auto"},
        "/rings": {"type": "boolean"},
        "/hold_out": {"type": "boolean"},
        "/precision": {"type": "choice", "choices": ["standard", "reference"]},
        "/mu_water": {"type": "number", "minimum": 1e-09, "maximum": 1000},
        "/priority": {"type": "choice", "choices": ["routine", "urgent", "stat"]},
        "/devices": {"type": "integer", "minimum": 1, "maximum": 16, "word": "all"},
    },
    "scan": {
        "/detector/columns": {"type": "integer", "minimum": 1, "maximum": 16384},
        "/detector/rows": {"type": "integer", "minimum": 1, "maximum": 16384},
        "/detector/pixel_mm": {"type": "numbers", "minimum": 1e-06, "maximum": 10000, "count": 2},
        "/projections/count": {"type": "integer", "minimum": 1, "maximum": 20000},
        "/projections/sample": {"type": "choice", "choices": ["float32", "uint16"]},
        "/projections/quantity": {"type": "choice", "choices": ["line_integral", "intensity"]},
        "/projections/air": {"type": "number", "minimum": 1e-06, "maximum": 1000000000000},
        "/projections/saturation": {"type": "number", "minimum": 1e-06, "maximum": 1000000000000},
        "/geometry/source_to_isocentre_mm": {"type": "number", "minimum": 1e-06, "maximum": 1000000},
        "/geometry/source_to_detector_mm": {"type": "number", "minimum": 1e-06, "maximum": 1000000},
        "/geometry/detector_offset_mm": {"type": "numbers", "minimum": -1000000, "maximum": 1000000, "count": 2},
        "/geometry/source_offset_mm": {"type": "numbers", "minimum": -1000000, "maximum": 1000000, "count": 2},
        "/geometry/first_angle_deg": {"type": "number", "minimum": -1000000, "maximum": 1000000},
        "/geometry/angle_step_deg": {"type": "number", "minimum": -360, "maximum": 360},
    },
}
# The end of the table.


class Error(Exception):
    """Anything that goes wrong between here and the daemon."""


class Broken(Error):
    """No answer, or one that broke off, for longer than the client's patience."""


class Problem(Error):
    """The daemon refused (RFC 9457).

    Attributes:
        status: of HTTP, e.g. 422.
        type: ``urn:cbctd:problem:...``, stable.
        title: what kind of problem it is.
        detail: one sentence with the number that was wrong and the one that was expected.
        pointer: RFC 6901 pointer to the field of the request, or "".
        request_id: to be found in the daemon's log; "" where the client itself has refused a value, before sending it.
    """

    def __init__(self, status: int, document: Mapping[str, Any]) -> None:
        self.status = status
        self.type = str(document.get("type", "about:blank"))
        self.title = str(document.get("title", f"status {status}"))
        self.detail = str(document.get("detail", ""))
        self.pointer = str(document.get("pointer", ""))
        self.request_id = str(document.get("request_id", ""))
        where = f"{self.pointer}: " if self.pointer else ""
        super().__init__(f"{where}{self.title}{': ' if self.detail else ''}{self.detail} (status {status})")


class JobFailed(Error):
    """The job ended without success; `job` is its document, `state` is ``failed`` or ``cancelled``."""

    def __init__(self, job: Document) -> None:
        self.job = job
        self.state = str(job.get("state"))
        super().__init__(f"job {job.get('id')} {self.state}: {(job.get('error') or {}).get('detail', '')}".rstrip(": "))


class CalibrationFailed(Error):
    """The pictures do not fit the phantom; `calibration` is the calibration's document."""

    def __init__(self, calibration: Document) -> None:
        self.calibration = calibration
        super().__init__(f"calibration {calibration.get('id')}: {(calibration.get('error') or {}).get('detail', '')}")


class Event(NamedTuple):
    """Something that happened to a job.

    ``kind`` is ``state``, ``progress``, ``volume``, ``warning``, ``removed`` or ``end``; ``data["job"]`` names the job;
    ``id`` grows and is never used twice.
    """

    id: int
    kind: str
    data: Document


@dataclass(frozen=True)
class Volume:
    """A kept volume.

    Attributes:
        name: ``fdk``, ``fdk-tv``, ``iter-5`` ..., ``final``.
        voxels: ``[z][y][x]``, float32 in 1/mm or int16 in Hounsfield units.
        spacing_mm: of voxels along the world's x, y and z.
        origin_mm: centre of voxel 0,0,0 in the world: x, y, z.
        stage: ``fdk``, ``tv``, or the algorithm of the iterations, ``sart``, ``cgls`` or ``fista``.
        iteration: 0 before the first.
        world_to_patient: 4 x 4, from (x, y, z, 1) of the world in mm to the patient's left, posterior and superior
            (DICOM's LPS); None: nobody has said how the patient lies, and left and right are not known.
    """

    name: str
    voxels: Array
    spacing_mm: Tuple[float, float, float]
    origin_mm: Tuple[float, float, float]
    stage: str
    iteration: int
    world_to_patient: Optional[Array] = None


@dataclass(frozen=True)
class Geometry:
    """Where source and detector stand in each view.

    Attributes:
        document: ``geometry`` of a scan, as the API takes it.
        pixel_mm: pitch of the detector's pixels along columns and rows.
    """

    document: Document
    pixel_mm: Tuple[float, float]

    @staticmethod
    def circular(
        source_to_isocentre_mm: float,
        source_to_detector_mm: float,
        pixel_mm: Sequence[float],
        *,
        angles_deg: Optional[npt.ArrayLike] = None,
        first_angle_deg: float = 0.0,
        angle_step_deg: Optional[float] = None,
        detector_offset_mm: Sequence[float] = (0.0, 0.0),
        source_offset_mm: Sequence[float] = (0.0, 0.0),
    ) -> Geometry:
        """A circular orbit about z: at gantry angle b the source stands at ``D (cos b, sin b, 0)``, columns run along
        ``(-sin b, cos b, 0)``, rows along z. Either a list of angles, or the first and the step."""
        document: Document = {
            "kind": "circular",
            "source_to_isocentre_mm": float(source_to_isocentre_mm),
            "source_to_detector_mm": float(source_to_detector_mm),
            "detector_offset_mm": [float(x) for x in detector_offset_mm],
            "source_offset_mm": [float(x) for x in source_offset_mm],
        }
        if angles_deg is not None:
            document["angles_deg"] = np.asarray(angles_deg, dtype=float).ravel().tolist()
        else:
            document["first_angle_deg"] = float(first_angle_deg)
            if angle_step_deg is not None:
                document["angle_step_deg"] = float(angle_step_deg)
        return Geometry(document, _pair(pixel_mm))

    @staticmethod
    def matrices(matrices: npt.ArrayLike, pixel_mm: Sequence[float]) -> Geometry:
        """Calibrated projection matrices ``[view][3][4]``, taking (x, y, z, 1) in mm to w (column, row, 1) in pixels,
        any overall scale and sign."""
        rows = np.asarray(matrices, dtype=float)
        return Geometry({"kind": "matrices", "matrices": rows.reshape(len(rows), 12).tolist()}, _pair(pixel_mm))

    @staticmethod
    def views(
        source_mm: npt.ArrayLike,
        pixel0_mm: npt.ArrayLike,
        column_step_mm: npt.ArrayLike,
        row_step_mm: npt.ArrayLike,
        pixel_mm: Sequence[float],
    ) -> Geometry:
        """Vectors ``[view][3]``: the source, the centre of column 0 and row 0, from one column to the next, from one
        row to the next."""
        arrays = {
            "source_mm": source_mm,
            "pixel0_mm": pixel0_mm,
            "column_step_mm": column_step_mm,
            "row_step_mm": row_step_mm,
        }
        lists = {name: np.asarray(value, dtype=float).reshape(-1, 3).tolist() for name, value in arrays.items()}
        if len({len(value) for value in lists.values()}) != 1:
            raise ValueError("source, pixel0, column step and row step have different numbers of views")
        views = [dict(zip(lists, vectors)) for vectors in zip(*lists.values())]
        return Geometry({"kind": "views", "views": views}, _pair(pixel_mm))

    @staticmethod
    def calibration(calibration: str, pixel_mm: Sequence[float], *, angles_deg: Optional[npt.ArrayLike] = None) -> Geometry:
        """What a calibration of the daemon has found (`Client.calibrate`), view by view, or by the nominal angles of the
        scan's sources, for any number of views of the same sweep."""
        document: Document = {"kind": "calibration", "id": calibration}
        if angles_deg is not None:
            document["angles_deg"] = np.asarray(angles_deg, dtype=float).ravel().tolist()
        return Geometry(document, _pair(pixel_mm))


def _token(path: Optional[str]) -> Optional[str]:
    if path is None and os.environ.get("CBCT_TOKEN"):
        return os.environ["CBCT_TOKEN"]
    path = path or os.environ.get("CBCT_TOKEN_FILE")
    if not path:
        return None
    with open(path, encoding="ascii") as file:
        return file.read().strip()


class _Adapter(requests.adapters.HTTPAdapter):
    """Connections whose peer is probed while they are silent."""

    def init_poolmanager(self, *args: Any, **options: Any) -> None:
        wanted = [(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1), (socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)]
        for name, value in (("TCP_KEEPIDLE", 10), ("TCP_KEEPINTVL", 5), ("TCP_KEEPCNT", 4)):
            if hasattr(socket, name):
                wanted.append((socket.IPPROTO_TCP, getattr(socket, name), value))
        super().init_poolmanager(*args, socket_options=wanted, **options)


class Client:
    """A daemon.

    Args:
        url: ``http://HOST:PORT`` or ``https://HOST:PORT``; default ``$CBCT_URL``, else ``http://127.0.0.1:2228``.
        timeout: s, to wait for a connection and between two bytes of an answer.
        patience: s, for how long broken connections are taken up again and a busy daemon is asked again before
            `Broken` or `Problem` is raised. One that was never reached is given up at once.
        token: what the daemon asks for; default ``$CBCT_TOKEN``.
        token_file: a file that has it; default ``$CBCT_TOKEN_FILE``. Goes before ``$CBCT_TOKEN``.
        cacert: a file of those who sign the daemon's certificate; default ``$CBCT_CACERT``, else those that requests trusts.
        cert: a client certificate in place of a token, a file or (certificate, key).
    """

    def __init__(
        self,
        url: Optional[str] = None,
        *,
        timeout: float = 60.0,
        patience: float = 60.0,
        token: Optional[str] = None,
        token_file: Optional[str] = None,
        cacert: Optional[str] = None,
        cert: Union[str, Tuple[str, str], None] = None,
    ) -> None:
        self.url = (url or os.environ.get("CBCT_URL") or "http://127.0.0.1:2228").rstrip("/")
        self.timeout = timeout
        self.patience = patience
        self._reached = False
        # One for all threads: its pool of connections is made for that, and of its own state nothing changes.
        self._session = requests.Session()
        # The daemon is near: no proxies, and no passwords of other services.
        self._session.trust_env = False
        self._session.headers["User-Agent"] = "cbctd-python"
        token = token or _token(token_file)
        if token:
            self._session.headers["Authorization"] = f"Bearer {token}"
        self._session.verify = cacert or os.environ.get("CBCT_CACERT") or True
        self._session.cert = cert
        for scheme in ("http://", "https://"):
            self._session.mount(scheme, _Adapter(pool_maxsize=32))

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes all connections."""
        self._session.close()

    # ---- scans ----

    def create_scan(
        self,
        geometry: Geometry,
        shape: Sequence[int],
        *,
        dtype: npt.DTypeLike = np.float32,
        name: Optional[str] = None,
        quantity: str = "line_integral",
        patient: Union[str, Mapping[str, Any], npt.ArrayLike, None] = None,
        study: Optional[Mapping[str, str]] = None,
        **projections: Any,
    ) -> Document:
        """Announces a scan; returns its document, with ``id``, ``derived`` and ``warnings``.

        Args:
            geometry: of its views.
            shape: (views, rows, columns).
            dtype: of what is going to be uploaded, float32 or uint16.
            name: for people.
            quantity: ``line_integral``, or ``intensity`` with ``air=60000`` or with `put_flat` later.
            patient: how the patient lies: ``"HFS"``, ``"HFP"``, ``"FFS"``, ``"FFP"``, ``"HFDL"``, ``"HFDR"``,
                ``"FFDL"`` or ``"FFDR"`` on a table to which the world is fixed, or a rigid 4 x 4 matrix from the world
                to the patient's LPS mm; None: not known, and then nothing says where left and right are. A mapping is
                the request's own member, which also has ``name``, ``id``, ``birth_date`` and ``sex``.
            study: ``uid``, ``accession_number``, ``description`` and others, for DICOM.
            projections: more members of ``projections`` in the request, e.g. ``air``, ``saturation``.
        """
        views, rows, columns = (int(n) for n in shape)
        members = {"count": views, "sample": _sample(dtype), "quantity": quantity}
        members.update((key, value) for key, value in projections.items() if value is not None)
        request: Document = {
            "detector": {"columns": columns, "rows": rows, "pixel_mm": list(geometry.pixel_mm)},
            "projections": members,
            "geometry": geometry.document,
        }
        if name is not None:
            request["name"] = name
        if patient is not None:
            request["patient"] = _patient(patient)
        if study is not None:
            request["study"] = dict(study)
        _check("scan", request)
        # A second one by mistake would stay for ever.
        return self._json("POST", "/v1/scans", json=request, repeatable=False)

    def scan(self, scan: str) -> Document:
        """The scan's document; ``missing`` has the runs [first, last] of projections that are not there."""
        return self._json("GET", f"/v1/scans/{scan}")

    def scans(self, **wanted: str) -> Iterator[Document]:
        """Scans, newest first; all, or those with ``state``, ``label`` and ``text`` as the API has them."""
        return self._pages("/v1/scans", "scans", wanted)

    def delete_scan(self, scan: str) -> None:
        """Removes a scan with its projections; `Problem` 409 while a job uses it."""
        self._delete(f"/v1/scans/{scan}")

    def upload(
        self,
        scan: str,
        projections: npt.ArrayLike,
        *,
        connections: int = 4,
        compress: bool = False,
        progress: Optional[Progress] = None,
    ) -> None:
        """Sends what is missing of a scan's projections, in runs over several connections; returns when all of them
        are on the daemon's disk. To go on after a break, also in another process, call it again.

        Args:
            scan: its id.
            projections: ``[view][row][column]``, all of them; a memory-mapped file is read run by run. float32, or
                uint16 where the scan says so; other types are converted where nothing is lost by it.
            connections: at the same time.
            compress: with zstd, where a module for it is installed; worth it for slow networks only.
            progress: called with the number of projections that are there and the number of all.
        """
        document = self.scan(scan)
        stack = np.asanyarray(projections)
        dtype = _wire_type(document)
        shape = (document["projections"]["count"], document["detector"]["rows"], document["detector"]["columns"])
        if stack.shape != shape:
            raise ValueError(f"projections of shape {stack.shape}, the scan has {shape}")
        _check_cast(stack.dtype, dtype)
        run = max(1, _RUN_BYTES // max(1, int(np.prod(shape[1:])) * dtype.itemsize))
        give_up = time.monotonic() + self.patience
        left = _count(document["missing"])
        while left > 0:
            if progress is not None:
                progress(shape[0] - left, shape[0])
            runs = _split(document["missing"], run)
            broken = self._send_runs(scan, stack, dtype, runs, connections, compress, progress)
            document = self.scan(scan)
            if _count(document["missing"]) < left:
                give_up = time.monotonic() + self.patience
            elif broken is None or time.monotonic() > give_up:
                raise Broken(f"projections are not taken: {broken}") from broken
            left = _count(document["missing"])
        if progress is not None:
            progress(shape[0], shape[0])

    def put_projection(self, scan: str, view: int, image: npt.ArrayLike) -> bool:
        """Sends one projection ``[row][column]`` as it is acquired. False when the same was there already."""
        document = self.scan(scan)
        return self._put_image(document, f"projections/{int(view)}", image, _wire_type(document))

    def put_flat(self, scan: str, image: npt.ArrayLike) -> bool:
        """Sends the flat image ``[row][column]`` of a scan of intensities, float32. False when it was there."""
        return self._put_image(self.scan(scan), "flat", image, _FLOAT32)

    def put_dark(self, scan: str, image: npt.ArrayLike) -> bool:
        """Sends the dark image ``[row][column]`` of a scan of intensities, float32. False when it was there."""
        return self._put_image(self.scan(scan), "dark", image, _FLOAT32)

    def put_scatter(self, scan: str, view: int, image: npt.ArrayLike) -> bool:
        """Sends the image ``[row][column]`` of a view's scatter, float32 counts, of a scan that was made with
        ``scatter={"kind": "images", "columns": 64, "rows": 48, "every": 10}``: of view 0, every tenth and the last. False
        when the same was there already."""
        document = self.scan(scan)
        scatter = document.get("scatter")
        shape = None if scatter is None else (scatter["rows"], scatter["columns"])
        return self._put_image(document, f"scatter/{int(view)}", image, _FLOAT32, shape)

    def scatter(self, scan: str, view: int) -> Array:
        """The image ``[row][column]`` of a view's scatter, as it was stored."""
        scatter = self.scan(scan).get("scatter") or {}
        body = self._request("GET", f"/v1/scans/{scan}/scatter/{int(view)}").content
        return np.frombuffer(body, dtype=_FLOAT32).reshape(scatter["rows"], scatter["columns"])

    def delete_scatter(self, scan: str, view: int | None = None) -> None:
        """Removes the image of a view's scatter, or all of them, so that others can be put."""
        self._delete(f"/v1/scans/{scan}/scatter" + ("" if view is None else f"/{int(view)}"))

    def delete_image(self, scan: str, name: str) -> None:
        """Removes the image ``flat``, ``dark`` or ``defects``, so that another one can be sent; `Problem` 409 while a job
        runs with it."""
        self._delete(f"/v1/scans/{scan}/{name}")

    def projection(self, scan: str, view: int) -> Array:
        """One projection ``[row][column]`` as it was stored."""
        document = self.scan(scan)
        detector = document["detector"]
        body = self._request("GET", f"/v1/scans/{scan}/projections/{int(view)}").content
        return np.frombuffer(bytearray(body), _wire_type(document)).reshape(detector["rows"], detector["columns"])

    # ---- calibrations ----

    def calibrate(
        self,
        scan: str,
        phantom: Mapping[str, Any],
        *,
        arm: Optional[str] = None,
        adjust_balls: bool = False,
        timeout: Optional[float] = None,
    ) -> Document:
        """Calibrates an arm from a complete scan of balls and waits for the result; its document has the residuals, what
        was refused and ``geometry``. `CalibrationFailed` where the pictures do not fit the phantom.

        Args:
            scan: id of the scan, whose geometry is the nominal one.
            phantom: ``{"balls_mm": [[x, y, z, diameter], ...]}``, or of the kind circles or helix.
            arm: a name of the arm, for people.
            adjust_balls: the balls' own places follow the shadows, too.
            timeout: s; `TimeoutError` after these.
        """
        request: Document = {"scan": scan, "phantom": dict(phantom), "adjust_balls": adjust_balls}
        if arm is not None:
            request["arm"] = arm
        # A second one by mistake would stay for ever.
        document = self._json("POST", "/v1/calibrations", json=request, repeatable=False)
        end = None if timeout is None else time.monotonic() + timeout
        while document["state"] not in ("succeeded", "failed"):
            left = self.timeout / 2 if end is None else min(self.timeout / 2, max(0.0, end - time.monotonic()))
            document = self._json("GET", f"/v1/calibrations/{document['id']}", params={"wait": f"{left:.3f}"})
            if document["state"] not in ("succeeded", "failed") and end is not None and time.monotonic() >= end:
                raise TimeoutError(f"calibration {document['id']} is {document['state']} after {timeout} s")
        if document["state"] == "failed":
            raise CalibrationFailed(document)
        return document

    def keep_refinement(self, job: str, *, arm: Optional[str] = None) -> Document:
        """Keeps the geometry that a job has refined as a calibration for other scans of the arm; gives its document."""
        request: Document = {"job": job} if arm is None else {"job": job, "arm": arm}
        return self._json("POST", "/v1/calibrations", json=request, repeatable=False)

    def calibration(self, calibration: str) -> Document:
        """The calibration's document."""
        return self._json("GET", f"/v1/calibrations/{calibration}")

    def calibrations(self) -> Iterator[Document]:
        """All calibrations, newest first."""
        return self._pages("/v1/calibrations", "calibrations")

    def calibration_view(self, calibration: str, view: int) -> bytes:
        """A view of the balls as PNG, with a circle where the calibration has each of them."""
        return self._bytes(f"/v1/calibrations/{calibration}/views/{view}", {})

    def delete_calibration(self, calibration: str) -> None:
        """Removes a calibration; scans that use it keep its matrices."""
        self._delete(f"/v1/calibrations/{calibration}")

    # ---- jobs ----

    def submit(self, scan: str, recipe: Mapping[str, Any], *, idempotency_key: Optional[str] = None) -> Document:
        """Asks for a reconstruction; returns the job's document, with its ``id``. May come before the projections.

        Args:
            scan: its id.
            recipe: ``grid``, ``fdk``, ``sart``, ``tv``, ``emit``, ``priority`` ... as POST /v1/jobs takes them; a
                stage given as ``{}`` takes its defaults.
            idempotency_key: a repeat with the same key returns the same job; one is made up if none is given, so that
                a connection that breaks never makes two jobs.
        """
        _check("job", recipe)
        headers = {"Idempotency-Key": idempotency_key or uuid.uuid4().hex}
        return self._json("POST", "/v1/jobs", json={**recipe, "scan": scan}, headers=headers)

    def job(self, job: str) -> Document:
        """The job's document as it is."""
        return self._json("GET", f"/v1/jobs/{job}")

    def jobs(self, **wanted: str) -> Iterator[Document]:
        """Jobs, newest first; all, or those with ``state``, ``scan``, ``priority``, ``label`` and ``text``."""
        return self._pages("/v1/jobs", "jobs", wanted)

    def wait(self, job: str, timeout: Optional[float] = None) -> Document:
        """The job's document when it has ended. `JobFailed` unless it succeeded, `TimeoutError` after so many s."""
        end = None if timeout is None else time.monotonic() + timeout
        while True:
            left = self.timeout / 2 if end is None else min(self.timeout / 2, max(0.0, end - time.monotonic()))
            document = self._json("GET", f"/v1/jobs/{job}", params={"wait": f"{left:.3f}"})
            if document["state"] in ("succeeded", "failed", "cancelled"):
                return _judge(document)
            if end is not None and time.monotonic() >= end:
                raise TimeoutError(f"job {job} is {document['state']} after {timeout} s")

    def cancel(self, job: str) -> Optional[Document]:
        """Cancels a job that has not ended and waits for its end; returns its document. One that has ended is removed
        with its volumes: None."""
        response = self._request("DELETE", f"/v1/jobs/{job}", params={"wait": f"{self.timeout / 2:.3f}"})
        return None if response.status_code == 204 else dict(response.json())

    def delete_job(self, job: str) -> None:
        """Removes a job with its volumes; one that still runs is cancelled before."""
        while self.cancel(job) is not None:
            pass

    def events(self, job: Optional[str] = None, *, after: Union[int, str, None] = None) -> Iterator[Event]:
        """What happens to a job, from the first to its ``end``; or to all jobs, for ever. Nothing is missed and
        nothing comes twice, over broken connections and restarts of the daemon.

        Args:
            job: its id, None for all.
            after: goes on behind the event with this id; ``"latest"``: only what is new.
        """
        path = "/v1/events" if job is None else f"/v1/jobs/{job}/events"
        give_up = time.monotonic() + self.patience
        while True:
            params = {} if after is None else {"after": str(after)}
            try:
                with self._request("GET", path, params=params, stream=True, timeout=3 * _HEARTBEAT) as response:
                    if response.status_code == 204:
                        return
                    for event in _read_events(response):
                        give_up = time.monotonic() + self.patience
                        after = event.id
                        yield event
                        if event.kind == "end" and job is not None:
                            return
            except _BREAKS as error:
                if time.monotonic() > give_up:
                    raise Broken(f"{path}: {error}") from error
            time.sleep(0.5)

    # ---- volumes ----

    def volumes(
        self,
        job: str,
        *,
        after: Optional[str] = None,
        dtype: npt.DTypeLike = np.float32,
        scale: int = 1,
        compress: bool = False,
    ) -> Iterator[Volume]:
        """Each kept volume: those that are there, then each as it is made, to the job's end (`JobFailed` unless it
        succeeded). Digests are checked; a connection that breaks is taken up behind the last whole volume.

        Args:
            job: its id.
            after: goes on behind the volume of this name.
            dtype: float32 is 1/mm, int16 Hounsfield units.
            scale: each voxel the mean of ``scale**3``.
            compress: zstd on the way, where a module for it is installed.
        """
        headers = {"Accept-Encoding": "zstd" if compress and _zstd() is not None else "identity"}
        give_up = time.monotonic() + self.patience
        while True:
            params = {"format": "nrrd", "type": _volume_type(dtype), "scale": str(int(scale))}
            if after is not None:
                params["after"] = after
            try:
                # It may be long until the next one: whether the peer is still there is left to keep-alive probes.
                with self._request(
                    "GET", f"/v1/jobs/{job}/stream", params=params, headers=headers, stream=True, timeout=None
                ) as response:
                    for part in _read_parts(response):
                        give_up = time.monotonic() + self.patience
                        if part.headers["content-type"] == "application/json":
                            _judge(json.loads(bytes(part.body)))
                            return
                        after = part.headers["cbct-volume"]
                        yield _volume(part)
            except _BREAKS as error:
                if time.monotonic() > give_up:
                    raise Broken(f"stream of job {job}: {error}") from error
            time.sleep(0.5)

    def volume_list(self, job: str) -> List[Document]:
        """The documents of the kept volumes, oldest first: name, size, digest, statistics ..."""
        return list(self._pages(f"/v1/jobs/{job}/volumes", "volumes"))[::-1]

    def volume(self, job: str, name: str = "final", *, dtype: npt.DTypeLike = np.float32, scale: int = 1) -> Volume:
        """One kept volume; `dtype` and `scale` as in `volumes`."""
        params = {"format": "nrrd", "type": _volume_type(dtype), "scale": str(int(scale))}
        headers = {"Accept-Encoding": "identity"}
        response = self._request("GET", f"/v1/jobs/{job}/volumes/{name}", params=params, headers=headers)
        documents = self._pages(f"/v1/jobs/{job}/volumes?wait=0", "volumes")
        document = next(document for document in documents if document["name"] == name)
        told = {"cbct-volume": name, "cbct-stage": document["stage"], "cbct-iteration": str(document["iteration"])}
        return _volume(_Part(told, bytearray(response.content)))

    def volume_file(self, job: str, name: str = "final", **query: Any) -> bytes:
        """A kept volume as a file; ``format``: ``nifti`` (default), ``nifti.gz``, ``mha``, ``nrrd``, ``raw``.

        ``type`` and ``scale`` as GET /v1/jobs/{job}/volumes/{volume} takes them.
        """
        params = {key: str(value) for key, value in query.items()}
        headers = {"Accept-Encoding": "identity"}
        return self._bytes(f"/v1/jobs/{job}/volumes/{name}", params, headers)

    def provenance(self, job: str, name: str = "final") -> Document:
        """What a kept volume was made from: digests of scan and projections, recipe, program, device."""
        return self._json("GET", f"/v1/jobs/{job}/volumes/{name}/provenance")

    def refinement(self, job: str) -> Document:
        """What a job with ``"refine"`` has changed in each view, mm and degrees, and the geometry that was found."""
        return self._json("GET", f"/v1/jobs/{job}/refinement")

    def refinement_plot(self, job: str) -> bytes:
        """The same as a plot, PNG: shifts and turns over the views."""
        return self._bytes(f"/v1/jobs/{job}/refinement", {"format": "png"})

    def annotations(self, job: str) -> Tuple[Document, str]:
        """What was measured in the job's volumes, and the tag that a change of it names."""
        reply = self._request("GET", f"/v1/jobs/{job}/annotations")
        return dict(reply.json()), str(reply.headers["ETag"])

    def annotate(self, job: str, annotations: Mapping[str, Any], tag: str) -> str:
        """Replaces them where they still bear the tag (Problem 412 otherwise); gives the new one."""
        reply = self._request(
            "PUT", f"/v1/jobs/{job}/annotations", json=dict(annotations), headers={"If-Match": tag}, repeatable=False
        )
        return str(reply.headers["ETag"])

    def send(self, job: str, to: str, volumes: Union[str, Sequence[Union[int, str]], None] = None) -> List[Document]:
        """Sends volumes of a job to a destination, once it has ended: ``"last"`` (the default), ``"all"`` or a list of
        iterations. May be repeated. Returns the job's sendings."""
        body: Document = {"to": to} if volumes is None else {"to": to, "volumes": volumes}
        return list(self._json("POST", f"/v1/jobs/{job}/send", json=body)["sendings"])

    def sendings(self, job: str) -> List[Document]:
        """Where the job's volumes are sent to, and how far that is."""
        return list(self._json("GET", f"/v1/jobs/{job}/send")["sendings"])

    def stop_sending(self, job: str, to: str) -> None:
        """No attempt to send volumes of the job to this destination follows."""
        self._request("DELETE", f"/v1/jobs/{job}/send/{to}")

    def destinations(self, wait: float = 0) -> List[Document]:
        """The archives that volumes can be sent to; with ``wait``, asked now whether they answer."""
        return list(self._json("GET", "/v1/destinations", params={"wait": f"{wait:.3f}"})["destinations"])

    def slice(self, job: str, name: str = "final", **query: Any) -> bytes:
        """One plane as PNG: ``axis="z"``, ``index``, ``window`` and ``level`` in Hounsfield units; ``sheet=1`` gives a
        contact sheet, ``normal="1,0.5,0"`` a plane at any angle, ``thickness`` and ``mode`` a slab."""
        return self._bytes(f"/v1/jobs/{job}/volumes/{name}/slice", {key: str(value) for key, value in query.items()})

    # ---- the daemon ----

    def devices(self) -> List[Document]:
        """The workers and what they run on."""
        return list(self._json("GET", "/v1/devices")["devices"])

    def pin(self, what: str, pinned: bool = True) -> None:
        """Keeps ``scans/ID`` or ``jobs/ID`` whatever its age (``--keep`` of the daemon), or no more."""
        self._request("PUT" if pinned else "DELETE", f"/v1/{what}/pin")

    def limits(self) -> Document:
        """How many jobs, scans and bytes this client and all together have, and may have."""
        return self._json("GET", "/v1/limits")

    def clear_device(self, index: int) -> Document:
        """Gives jobs again to a device that was set aside; for the role ``admin``."""
        return self._json("POST", f"/v1/devices/{index}/clear")

    def quarantine(self) -> List[Document]:
        """What the daemon has set aside because it could not use it, and why."""
        return list(self._json("GET", "/v1/quarantine")["entries"])

    def ready(self) -> bool:
        """Whether a worker can take a job just now."""
        try:
            response = self._session.get(f"{self.url}/readyz", timeout=self.timeout)
        except _BREAKS:
            return False
        return bool(response.status_code == 200)

    # ---- everything in one call ----

    def recon(
        self,
        projections: npt.ArrayLike,
        geometry: Geometry,
        *,
        grid: Optional[Mapping[str, Any]] = None,
        fdk: Optional[Mapping[str, Any]] = {},  # noqa: B006  it is never changed
        sart: Optional[Mapping[str, Any]] = None,
        tv: Optional[Mapping[str, Any]] = None,
        emit: Sequence[Union[int, str]] = (),
        on_volume: Optional[Callable[[Volume], None]] = None,
        dtype: npt.DTypeLike = np.float32,
        quantity: str = "line_integral",
        air: Optional[float] = None,
        flat: Optional[npt.ArrayLike] = None,
        dark: Optional[npt.ArrayLike] = None,
        name: Optional[str] = None,
        patient: Union[str, npt.ArrayLike, None] = None,
        progress: bool = True,
        keep: bool = False,
        **recipe: Any,
    ) -> Volume:
        """Reconstructs and returns the final volume.

        Args:
            projections: ``[view][row][column]``, float32 or uint16; line integrals, or intensities.
            geometry: of the views.
            grid: ``{"size": [x, y, z], "spacing_mm": [x, y, z], "origin_mm": [x, y, z]}``; None: one is chosen.
            fdk, sart, tv: the stages' settings; ``{}`` takes their defaults, None leaves them out.
            emit: after which iterations `on_volume` gets a volume: ``"fdk"``, ``"fdk-tv"``, numbers.
            on_volume: called with each kept volume as it is made, the final one included.
            dtype: of the voxels: float32 is 1/mm, int16 Hounsfield units.
            quantity: ``line_integral``, or ``intensity`` with `air`, or `flat` and `dark` images ``[row][column]``.
            name: of the scan, for people.
            patient: how the patient lies, as `Client.create_scan` has it.
            progress: bars of tqdm, where it is installed.
            keep: leaves scan and job with the daemon; otherwise they are removed, also when this is interrupted.
            recipe: more members of the job's request, e.g. ``priority="urgent"``, ``cgls={}``; with ``preset="fast"``
                the stages that are None or ``{}`` are the preset's.
        """
        stack = np.asanyarray(projections)
        if stack.ndim != 3:
            raise ValueError(f"projections of shape {stack.shape}, expected [view][row][column]")
        sample = np.uint16 if stack.dtype == np.uint16 else np.float32
        stages = {"grid": grid, "fdk": fdk, "sart": sart, "tv": tv, "emit": list(emit), **recipe}
        if recipe.get("preset") is not None:
            stages = {name: stage for name, stage in stages.items() if stage or name not in ("fdk", "sart", "tv")}
        _check("job", stages)
        scan = self.create_scan(
            geometry, stack.shape, dtype=sample, name=name, quantity=quantity, patient=patient, air=air
        )["id"]
        job: Optional[str] = None
        try:
            if flat is not None:
                self.put_flat(scan, flat)
            if dark is not None:
                self.put_dark(scan, dark)
            document = self.submit(scan, {key: value for key, value in stages.items() if value is not None})
            job = str(document["id"])
            with _Bar("upload", "view", progress) as bar:
                self.upload(scan, stack, progress=bar.to)
            with _Bar("reconstruct", "iteration", progress) as bar:
                return self._follow(document, bar, on_volume, dtype)
        finally:
            if not keep:
                if job is not None:
                    self.delete_job(job)
                self.delete_scan(scan)

    def _follow(
        self, document: Document, bar: _Bar, on_volume: Optional[Callable[[Volume], None]], dtype: npt.DTypeLike
    ) -> Volume:
        job = str(document["id"])
        total = int(document.get("iterations") or 1)
        bar.to(0, total)
        for event in self.events(job):
            if event.kind == "progress":
                bar.to(int(event.data["iteration"]), total, residual=f"{event.data['residual']:.4g}")
            elif event.kind == "volume" and on_volume is not None and event.data["name"] != "final":
                on_volume(self.volume(job, str(event.data["name"]), dtype=dtype))
        self.wait(job)
        bar.to(total, total)
        final = self.volume(job, dtype=dtype)
        if on_volume is not None:
            on_volume(final)
        return final

    # ---- requests ----

    def _request(
        self,
        method: str,
        path: str,
        *,
        repeatable: bool = True,
        stream: bool = False,
        timeout: Optional[float] = -1.0,
        **options: Any,
    ) -> requests.Response:
        """Asks again while the connection breaks or the daemon is busy, as long as patience lasts. timeout: of the
        answer; None is for ever, below 0 the client's own."""
        give_up = time.monotonic() + self.patience
        read_timeout = self.timeout if timeout is not None and timeout < 0 else timeout
        pause = 0.1
        while True:
            try:
                response = self._session.request(
                    method, self.url + path, stream=stream, timeout=(self.timeout, read_timeout), **options
                )
            except _BREAKS as error:
                if not repeatable or not self._reached or time.monotonic() + pause > give_up:
                    raise Broken(f"{method} {self.url}{path}: {error}") from error
            else:
                self._reached = True
                if response.status_code < 400:
                    return response
                problem = _problem(response)
                if problem.status not in (429, 503) or time.monotonic() + pause > give_up:
                    raise problem
                pause = max(pause, _seconds(response.headers.get("Retry-After")))
            time.sleep(pause)
            pause = min(2 * pause, 5.0)

    def _json(self, method: str, path: str, **options: Any) -> Document:
        return dict(self._request(method, path, **options).json())

    def _bytes(self, path: str, params: Mapping[str, str], headers: Optional[Mapping[str, str]] = None) -> bytes:
        return bytes(self._request("GET", path, params=params, headers=headers).content)

    def _pages(self, path: str, name: str, wanted: Mapping[str, str] = {}) -> Iterator[Document]:
        after: Optional[str] = None
        while True:
            page = self._json("GET", path, params={**wanted, **({} if after is None else {"after": after})})
            yield from page[name]
            after = page["next"]
            if after is None:
                return

    def _delete(self, path: str) -> None:
        try:
            self._request("DELETE", path)
        except Problem as problem:
            # Gone already: this may be the second time that it was asked, after an answer that was lost.
            if problem.status != 404:
                raise

    def _put_image(
        self,
        scan: Document,
        name: str,
        image: npt.ArrayLike,
        dtype: np.dtype[Any],
        shape: Optional[Tuple[int, int]] = None,
    ) -> bool:
        array = np.asanyarray(image)
        expected = shape or (scan["detector"]["rows"], scan["detector"]["columns"])
        if array.shape != expected:
            raise ValueError(f"an image of shape {array.shape}, the scan has {expected}")
        _check_cast(array.dtype, dtype)
        body = array.astype(dtype, copy=False).tobytes()
        response = self._request("PUT", f"/v1/scans/{scan['id']}/{name}", data=body)
        return bool(response.status_code == 201)

    def _send_runs(
        self,
        scan: str,
        stack: Array,
        dtype: np.dtype[Any],
        runs: List[Tuple[int, int]],
        connections: int,
        compress: bool,
        progress: Optional[Progress],
    ) -> Optional[Exception]:
        """All runs once; what broke, None for nothing. `Problem` when one is refused."""
        done = len(stack) - sum(last - first + 1 for first, last in runs)
        lock = threading.Lock()
        broken: List[Exception] = []
        coder = _zstd() if compress else None

        def send(run: Tuple[int, int]) -> None:
            nonlocal done
            first, last = run
            body = stack[first : last + 1].astype(dtype, copy=False).tobytes()
            headers = {"Content-Type": "application/octet-stream"}
            if coder is not None:
                body = coder.compress(body, 1)
                headers["Content-Encoding"] = "zstd"
            try:
                # Not repeated as it is: of a run that broke the first ones are there already.
                self._request(
                    "PUT", f"/v1/scans/{scan}/projections/{first}-{last}", data=body, headers=headers, repeatable=False
                )
            except Broken as error:
                broken.append(error)
                time.sleep(0.2)
                return
            with lock:
                done += last - first + 1
                if progress is not None:
                    progress(done, len(stack))

        with ThreadPoolExecutor(max(1, min(connections, len(runs)))) as pool:
            tasks = [pool.submit(send, run) for run in runs]
            try:
                for task in tasks:
                    task.result()
            finally:
                for task in tasks:
                    task.cancel()
        return broken[0] if broken else None


def recon(projections: npt.ArrayLike, geometry: Geometry, *, url: Optional[str] = None, **options: Any) -> Volume:
    """`Client.recon` with a client of its own."""
    with Client(url) as client:
        return client.recon(projections, geometry, **options)


# ---- what the daemon says ----


def _problem(response: requests.Response) -> Problem:
    document: Document = {}
    try:
        if "json" in response.headers.get("Content-Type", ""):
            document = dict(response.json())
    except ValueError:
        pass
    finally:
        response.close()
    return Problem(int(response.status_code), document)


_INVALID = (400, "invalid", "The request is malformed")
_IMPOSSIBLE = (422, "impossible", "The request is well-formed, but cannot be done")


def _refusal(kind: Tuple[int, str, str], pointer: str, detail: str) -> Problem:
    status, name, title = kind
    return Problem(
        status, {"type": f"urn:cbctd:problem:{name}", "title": title, "detail": detail, "pointer": pointer}
    )


def _json_type(value: Any) -> str:
    """What the daemon calls a value's type."""
    if isinstance(value, bool):
        return "a boolean"
    if isinstance(value, (int, float)):
        return "a number"
    if isinstance(value, str):
        return "a string"
    if isinstance(value, (list, tuple)):
        return "an array"
    return "an object" if isinstance(value, Mapping) else "null"


def _check_number(value: Any, pointer: str, least: float, most: float) -> None:
    if _json_type(value) != "a number":
        raise _refusal(_INVALID, pointer, f"{_json_type(value)}, a number is expected")
    if not least <= value <= most:
        detail = f"{value:.10g}, a number from {least:.10g} to {most:.10g} is expected"
        raise _refusal(_IMPOSSIBLE, pointer, detail)


def _check_list(values: Any, pointer: str, row: Document) -> None:
    if _json_type(values) != "an array":
        detail = f"{_json_type(values)}, an array of {row['count']} numbers is expected"
        raise _refusal(_INVALID, pointer, detail)
    if len(values) != row["count"]:
        raise _refusal(_INVALID, pointer, f"{len(values)} numbers, {row['count']} are expected")
    whole = row["type"] == "integers"
    least, most = row["minimum"], row["maximum"]
    for i, value in enumerate(values):
        _check_number(value, f"{pointer}/{i}", *((-1e100, 1e100) if whole else (least, most)))
    for i, value in enumerate(values if whole else ()):
        if value != int(value):
            raise _refusal(_INVALID, f"{pointer}/{i}", f"{value:.10g}, a whole number is expected")
        if not least <= value <= most:
            detail = f"{value:.10g} {row['unit']}, {least:.10g} to {most:.10g} are expected"
            raise _refusal(_IMPOSSIBLE, f"{pointer}/{i}", detail)


def _check_value(value: Any, pointer: str, row: Document) -> None:
    if row["type"] in ("numbers", "integers"):
        _check_list(value, pointer, row)
    elif row["type"] == "boolean":
        if not isinstance(value, bool):
            raise _refusal(_INVALID, pointer, f"{_json_type(value)}, true or false is expected")
    elif row["type"] == "choice":
        if not (isinstance(value, str) and value in row["choices"]):
            what = "an unknown word" if isinstance(value, str) else _json_type(value)
            raise _refusal(_INVALID, pointer, f"{what}, one of {', '.join(row['choices'])} is expected")
    elif value != row.get("word"):
        if "word" in row and _json_type(value) != "a number":
            raise _refusal(_INVALID, pointer, f"a number or \"{row['word']}\" is expected")
        if row["type"] == "integer" and isinstance(value, float) and np.isfinite(value) and value % 1 != 0:
            raise _refusal(_INVALID, pointer, f"{value:.10g}, a whole number is expected")
        _check_number(value, pointer, row["minimum"], row["maximum"])


def _check(name: str, document: Mapping[str, Any]) -> None:
    """Refuses a value as the daemon would, in its words. Members that the table does not have are left to the daemon."""
    for pointer, row in _PARAMETERS[name].items():
        value: Any = document
        for member in pointer.split("/")[1:]:
            value = value.get(member) if isinstance(value, Mapping) else None
        if value is not None:
            _check_value(value, pointer, row)


def _judge(job: Document) -> Document:
    if job["state"] != "succeeded":
        raise JobFailed(job)
    return job


def _seconds(text: Optional[str]) -> float:
    """Of Retry-After; somebody's idea of an hour is not waited for."""
    try:
        return min(max(float(text or 0), 0.0), 30.0)
    except ValueError:
        return 1.0


def _read_events(response: requests.Response) -> Iterator[Event]:
    """Of text/event-stream; an event that was cut off is left out, it comes again."""
    fields: Dict[str, str] = {}
    rest = b""
    for chunk in response.iter_content(chunk_size=None):
        *lines, rest = (rest + chunk).split(b"\n")
        for line in lines:
            name, _, value = line.decode("utf-8", "replace").partition(": ")
            if line:
                fields[name] = value
                continue
            if "id" in fields and "data" in fields:
                yield Event(int(fields["id"]), fields.get("event", "message"), json.loads(fields["data"]))
            fields = {}


class _Part(NamedTuple):
    headers: Dict[str, str]  # names in lower case
    body: bytearray


class _Body:
    """A response's bytes, by lines and by lengths."""

    def __init__(self, response: requests.Response) -> None:
        self.chunks = response.iter_content(chunk_size=None)
        self.held = memoryview(b"")

    def more(self) -> None:
        chunk = next(self.chunks, b"")
        if not chunk:
            raise requests.exceptions.ConnectionError("the stream broke off")
        self.held = memoryview(bytes(self.held) + chunk) if len(self.held) else memoryview(chunk)

    def line(self) -> str:
        while True:
            text, newline, _ = bytes(self.held[:4096]).partition(b"\r\n")
            if newline:
                self.held = self.held[len(text) + 2 :]
                return text.decode("latin-1")
            self.more()

    def read(self, length: int) -> bytearray:
        to = bytearray(length)
        view, done = memoryview(to), 0
        while done < length:
            if not len(self.held):
                self.more()
            part = min(len(self.held), length - done)
            view[done : done + part] = self.held[:part]
            self.held = self.held[part:]
            done += part
        return to


def _read_parts(response: requests.Response) -> Iterator[_Part]:
    """Of multipart/mixed, with digests checked and zstd undone. What ends without the last boundary broke off."""
    boundary = "--" + response.headers["Content-Type"].partition("boundary=")[2].strip('"')
    body = _Body(response)
    while True:
        line = body.line()
        if line == boundary + "--":
            return
        if line != boundary:
            raise Error(f"the stream has no boundary, but {line[:60]!r}")
        headers = {}
        while (line := body.line()) != "":
            name, _, value = line.partition(":")
            headers[name.strip().lower()] = value.strip()
        content = body.read(int(headers["content-length"]))
        digest = headers.get("content-digest", "")
        if digest.startswith("sha-256=:") and base64.b64decode(digest[9:-1]) != hashlib.sha256(content).digest():
            raise Error("a part of the stream does not fit its digest")
        coder = _zstd()
        if headers.get("content-encoding") == "zstd" and coder is not None:
            content = bytearray(coder.decompress(content))
        if body.line() != "":
            raise Error("a part of the stream is longer than it says")
        yield _Part(headers, content)


def _volume(part: _Part) -> Volume:
    """NRRD says how large it is and where, in the patient: the axes are the scan's x, y and z all the same."""
    end = part.body.index(b"\n\n")
    lines = bytes(part.body[:end]).decode("ascii").split("\n")
    fields = dict(line.split(": ", 1) for line in lines if ": " in line and ":=" not in line)
    keys = dict(line.split(":=", 1) for line in lines if ":=" in line)
    dtype = {"float": _FLOAT32, "short": _INT16}[fields["type"]]
    sizes = [int(n) for n in fields["sizes"].split()]
    steps = [float(np.linalg.norm(_vector(text))) for text in fields["space directions"].split()]
    known = keys.get("cbct_world_to_patient")
    matrix = None if known is None else np.array(json.loads(known), np.float64).reshape(4, 4)
    origin = np.array(_vector(fields["space origin"]))
    if matrix is not None:
        origin = matrix[:3, :3].T @ (origin - matrix[:3, 3])
    # The header may end anywhere.
    voxels = np.require(np.frombuffer(part.body, dtype, offset=end + 2), requirements=["A", "W"])
    return Volume(
        name=part.headers["cbct-volume"],
        voxels=voxels.reshape(sizes[::-1]),
        spacing_mm=(steps[0], steps[1], steps[2]),
        origin_mm=(float(origin[0]), float(origin[1]), float(origin[2])),
        stage=part.headers["cbct-stage"],
        iteration=int(part.headers["cbct-iteration"]),
        world_to_patient=matrix,
    )


def _patient(patient: Union[str, Mapping[str, Any], npt.ArrayLike]) -> Document:
    if isinstance(patient, str):
        return {"position": patient}
    if isinstance(patient, Mapping):
        return dict(patient)
    return {"world_to_patient": np.asarray(patient, np.float64).ravel().tolist()}


# ---- arrays and lists ----


def _vector(text: str) -> Tuple[float, float, float]:
    x, y, z = (float(number) for number in text.strip("()").split(","))
    return x, y, z


def _pair(values: Sequence[float]) -> Tuple[float, float]:
    first, second = (float(x) for x in values)
    return first, second


def _sample(dtype: npt.DTypeLike) -> str:
    if np.dtype(dtype) not in (np.dtype(np.float32), np.dtype(np.uint16)):
        raise ValueError(f"projections of {np.dtype(dtype)}, expected float32 or uint16")
    return np.dtype(dtype).name


def _volume_type(dtype: npt.DTypeLike) -> str:
    if np.dtype(dtype) not in (np.dtype(np.float32), np.dtype(np.int16)):
        raise ValueError(f"voxels of {np.dtype(dtype)}, expected float32 (1/mm) or int16 (Hounsfield units)")
    return np.dtype(dtype).name


def _wire_type(scan: Document) -> np.dtype[Any]:
    return _UINT16 if scan["projections"]["sample"] == "uint16" else _FLOAT32


def _check_cast(have: np.dtype[Any], wanted: np.dtype[Any]) -> None:
    """Of one kind, or from integers that a float32 holds: float64 is rounded, but nothing is cut off."""
    if not (np.can_cast(have, wanted, "same_kind") and (wanted.kind == "f" or np.can_cast(have, wanted))):
        raise ValueError(f"an array of {have} cannot become {wanted}")


def _count(runs: Sequence[Sequence[int]]) -> int:
    return sum(last - first + 1 for first, last in runs)


def _split(runs: Sequence[Sequence[int]], length: int) -> List[Tuple[int, int]]:
    return [(at, min(at + length - 1, last)) for first, last in runs for at in range(first, last + 1, length)]


class _Zstd(NamedTuple):
    compress: Callable[[bytes, int], bytes]
    decompress: Callable[[bytearray], bytes]


def _zstd() -> Optional[_Zstd]:
    """Python's own module (3.14), or zstandard; None where there is neither."""
    try:
        from compression import zstd

        return _Zstd(zstd.compress, zstd.decompress)
    except ImportError:
        pass
    try:
        import zstandard
    except ImportError:
        return None
    return _Zstd(
        lambda data, level: bytes(zstandard.ZstdCompressor(level=level).compress(data)),
        lambda data: bytes(zstandard.ZstdDecompressor().decompressobj().decompress(data)),
    )


class _Bar:
    """tqdm's bar where it is installed and wanted, else nothing."""

    def __init__(self, label: str, unit: str, wanted: bool) -> None:
        self.bar: Any = None
        if not wanted:
            return
        try:
            from tqdm.auto import tqdm
        except ImportError:
            return
        self.bar = tqdm(desc=label, unit=unit, total=0)

    def __enter__(self) -> _Bar:
        return self

    def __exit__(self, *_: object) -> None:
        if self.bar is not None:
            self.bar.close()

    def to(self, done: int, total: int, **more: str) -> None:
        if self.bar is None:
            return
        self.bar.total = total
        if more:
            self.bar.set_postfix(more, refresh=False)
        self.bar.update(done - self.bar.n)
