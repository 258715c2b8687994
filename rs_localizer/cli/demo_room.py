"""The demo's last act: a room is mapped from one walk, and another walk is localized in it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from rs_localizer import data
from rs_localizer.core.camera import Camera
from rs_localizer.evaluation import plots
from rs_localizer.evaluation.comparison import Recording, Result, compare, table
from rs_localizer.evaluation.map_pictures import localized_picture
from rs_localizer.evaluation.room_mapping import Piece, Room, without_refinement
from rs_localizer.io.estimates import Motions
from rs_localizer.io.maps.npz import write_npz
from rs_localizer.io.recording import make_camera_info
from rs_localizer.io.topics import KEYPOINTS
from rs_localizer.io.trajectories import Trajectory, Twists, read_tum
from rs_localizer.mapping.colmap import Effort, require
from rs_localizer.process.missing import explain
from rs_localizer.simulation.frames import middle_stamp
from rs_localizer.simulation.renderer import ImageSettings

ROOM = "room.png"
# A quarter of VGA: all of it within half a minute.
_CAMERA = Camera(
    320, 240, np.array([[250.0, 0.0, 159.5], [0.0, 250.0, 119.5], [0.0, 0.0, 1.0]]),
    readout_time=0.03,
)  # fmt: skip
_SENSOR = ImageSettings(noise=2.0)
_KEYPOINTS = 300
_WALK, _FLIGHT = Piece(28.0, 11.8, 15.0), Piece(40.0, 8.0, 10.0)
_EFFORT = Effort(adjusted=60)


def _missing() -> str:
    """Why there can be no map; empty: there can."""
    try:
        require()
    except ImportError as error:
        return explain(error)
    return ""


class RoomScene:
    """The room, its maps and the keypoints of the second walk.

    Args:
        directory: for the maps.
    """

    readout_time = _CAMERA.readout_time

    def __init__(self, directory: Path) -> None:
        self.map_file, self.global_map_file = directory / "room.npz", directory / "global.npz"
        self._room = Room(read_tum(data.path(data.HAND_MOTION)), _CAMERA, _SENSOR, _KEYPOINTS)
        folder = directory / "colmap"
        folder.mkdir()
        with TemporaryDirectory() as images:
            with _bar("Walking through a room", len(self._room.stamps(_WALK))) as step:
                views = self._room.look(_WALK, Path(images), lambda: step(1))
            built = self._room.build(views, folder, _bar, _EFFORT)
        self._landmarks = built.landmarks
        write_npz(self.map_file, built.landmarks)
        write_npz(self.global_map_file, without_refinement(built))

    def record(self) -> Recording:
        """The keypoints of the second walk, and the truth at the middle rows."""
        stamps = self._room.stamps(_FLIGHT)
        with _bar("Walking there again", len(stamps)) as step:
            clouds = self._room.clouds(_FLIGHT, lambda: step(1))
        middles = np.array([middle_stamp(_CAMERA, stamp) for stamp in stamps], np.int64)
        states = [self._room.motion.state(int(middle), np.zeros(1)) for middle in middles]
        rotations = np.concatenate([state.rotations for state in states])
        truth = Motions(
            Trajectory(
                middles,
                np.concatenate([state.positions for state in states]),
                Rotation.from_matrix(rotations).as_quat(),
            ),
            Twists(
                middles,
                np.concatenate([state.angular for state in states]),
                np.concatenate([state.linear for state in states]),
            ),
        )
        infos = [make_camera_info(_CAMERA, stamp) for stamp in stamps]
        return Recording(stamps, infos, clouds, {}, truth)

    def picture(self, recording: Recording, results: Mapping[str, Result]) -> Figure:
        """Where the camera was, among the landmarks."""
        assert recording.truth is not None
        poses = {name: result.poses for name, result in results.items()}
        return localized_picture(self._landmarks.points, recording.truth.poses, poses)


def play_room(
    session: Any,
    methods: Mapping[str, Mapping[str, Any]],
    names: Mapping[str, str],
    out: Path,
    directory: Path,
) -> None:
    """Let the nodes of several methods localize the second walk; print and draw what they said.

    Args:
        session: of the live nodes.
        methods: their settings, by name: the rolling shutter's first, then the global one's.
        names: what they are called in tables.
        out: for the picture.
        directory: for what is passing.
    """
    if reason := _missing():
        print(f"\nA room without markers is left out: {reason}")
        return
    room = RoomScene(directory)
    recording = room.record()
    maps = (room.map_file, room.global_map_file)
    given = {
        name: {**settings, "map_file": str(file)}
        for (name, settings), file in zip(methods.items(), maps, strict=True)
    }
    with tqdm(
        total=len(recording.clouds), unit="frame", desc="Room without markers", disable=None
    ) as bar:
        answers = session.play(
            recording,
            room.readout_time,
            given,
            bar.update,
            lossless=(next(iter(methods)),),
            topic=KEYPOINTS,
        )
    results = {names[name]: compare(answers[name], recording.truth) for name in methods}
    print(f"\n{table('A room mapped without markers', recording, results)}", flush=True)
    plots.save(room.picture(recording, results), out / ROOM)
    print(out / ROOM)


@contextmanager
def _bar(name: str, total: int) -> Iterator[Callable[[int], object]]:
    with tqdm(total=total, desc=name, disable=None) as bar:
        yield bar.update
