"""The demo's third act: a cube among markers, seen by a camera that a hand shakes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from tqdm import tqdm

from rs_localizer import data
from rs_localizer.evaluation.comparison import Recording, Result
from rs_localizer.evaluation.cube_clip import (
    CLIP_SENSOR,
    OURS,
    P3P,
    RUN_UP,
    clip_stamps,
    draw_clip,
)
from rs_localizer.io.bags import BagWriter
from rs_localizer.io.recording import write_frame
from rs_localizer.io.trajectories import read_tum
from rs_localizer.io.video import Image
from rs_localizer.simulation.marker_frames import CAMERA, MarkerWalls
from rs_localizer.simulation.recording import write_truth

CUBE = "cube.gif"


class CubeScene:
    """Rendered images of marker walls, the correspondences in them, and the cube."""

    def __init__(self) -> None:
        self._walls = MarkerWalls(read_tum(data.path(data.HAND_MOTION)), 0, CLIP_SENSOR)
        self._images: dict[int, Image] = {}
        self._middles: dict[int, int] = {}

    readout_time = CAMERA.readout_time

    def record(self, path: Path, most: int | None) -> Path:
        """Render the clip, find the markers, and write them into a bag."""
        stamps = clip_stamps(self._walls, most)
        now = np.zeros(1)
        with BagWriter(path) as bag:
            frames = self._walls.frames(stamps)
            bar = tqdm(frames, "Rendering a cube's room", len(stamps), unit="frame", disable=None)
            for frame, image in bar:
                stamp, middle = frame.stamp_ns, frame.middle_ns
                self._images[stamp], self._middles[stamp] = image, middle
                ids = np.arange(len(frame.points))
                write_frame(bag, CAMERA, stamp, frame.points, frame.pixels, ids)
                for moment in (stamp, middle):
                    write_truth(bag, moment, self._walls.motion.state(moment, now))
        return path

    def draw(
        self, recording: Recording, results: Mapping[str, Result], ours: str, p3p: str, out: Path
    ) -> str:
        """Write the animated picture; a sentence on where the cube is."""
        stamps = recording.stamps_ns[RUN_UP:]
        motions = [
            {
                name: answer.motion(self.readout_time) if answer is not None else None
                for name, answer in (
                    (P3P, results[p3p].answers.get(stamp)),
                    (OURS, results[ours].answers.get(stamp)),
                )
            }
            for stamp in stamps
        ]
        clip = draw_clip(
            self._walls,
            [self._middles[stamp] for stamp in stamps],
            [self._images[stamp] for stamp in stamps],
            motions,
        )
        out.write_bytes(clip.animation)
        medians = {name: np.median(errors) for name, errors in clip.errors.items()}
        return (
            f"The cube's farthest corner is off by {medians[OURS]:.2f} px in the median, "
            f"by {medians[P3P]:.1f} px with P3P."
        )
