"""Turn a video of a chessboard into a recording: ``python -m rs_localizer.lab.board_video``.

The recording has the camera's calibration, the corners of each image where the whole board is
seen as correspondences in raw pixels, and these images. A video knows no time stamps: image
``k`` gets the time ``k / rate``, so the readout time is right as a share of the frame time.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from rs_localizer.arguments import number
from rs_localizer.core.camera import Camera, DistortionModel, ScanDirection
from rs_localizer.core.so3 import Array
from rs_localizer.io.bags import BagWriter
from rs_localizer.io.calibration import read_calibration
from rs_localizer.lab.boards import Board, find_corners
from rs_localizer.lab.recording import write_frame, write_jpeg, write_parameters
from rs_localizer.lab.video import read_video
from rs_localizer.settings import settings

# A time of 0 means "none" to ROS.
_START_NS = 1_000_000_000
# After this long without the board (s) it may lie the other way round.
_LONGEST_LOSS = 1.0


@dataclass(frozen=True, slots=True)
class Recorded:
    """What became of a video."""

    images: int
    skipped: int  # the board was not seen as a whole
    residual: float  # px rms of a global-shutter pose, median of the images


def record_board(
    video: Path | str,
    camera: Camera,
    board: Board,
    out: Path | str,
    *,
    rate: float,
    with_images: bool = True,
) -> Recorded:
    """Write the recording of a board video.

    Raises:
        ValueError: for an unreadable video, or one that never shows the board.
    """
    if not 0.0 < rate < np.inf:
        raise ValueError(f"rate must be more than 0 images per second, got {rate}")
    ids = np.arange(board.columns * board.rows)
    residuals: list[float] = []
    corners: Array | None = None
    last_seen, images = 0, 0
    with BagWriter(out) as bag:
        for jpeg, image in tqdm(read_video(video), unit="image", desc="board", disable=None):
            if image.shape != (camera.height, camera.width):
                raise ValueError(
                    f"{video} has images of {image.shape[1]}x{image.shape[0]}, the calibration is "
                    f"for {camera.width}x{camera.height}"
                )
            known = corners if (images - last_seen) / rate <= _LONGEST_LOSS else None
            found = find_corners(image, board, known)
            if found is not None:
                corners, last_seen = found, images
                residuals.append(static_residual(camera, board.points, found))
                stamp_ns = _START_NS + round(images * 1e9 / rate)
                write_frame(bag, camera, stamp_ns, board.points, found, ids)
                if with_images:
                    write_jpeg(bag, stamp_ns, jpeg)
            images += 1
        if not residuals:
            raise ValueError(
                f"none of the {images} images of {video} shows {board.columns}x{board.rows} corners"
            )
    return Recorded(images, images - len(residuals), float(np.median(residuals)))


def static_residual(camera: Camera, points: Array, pixels: Array) -> float:
    """Reprojection error (px rms) of the best global-shutter pose."""
    fisheye = camera.distortion_model == DistortionModel.EQUIDISTANT
    K, D = (np.eye(3), None) if fisheye else (camera.K, camera.D)
    seen = camera.rays(pixels) if fisheye else pixels
    _, rotation, translation = cv2.solvePnP(points, seen, K, D)
    local = points @ cv2.Rodrigues(rotation)[0].T + translation.T
    return float(np.sqrt(np.mean(np.sum((camera.project(local) - pixels) ** 2, axis=1))))


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m rs_localizer.lab.board_video",
        description="Turn a video of a chessboard into a recording for rs_localizer.",
    )
    parser.add_argument("video", type=Path, help=".mjpeg, or anything that OpenCV opens")
    parser.add_argument(
        "--calibration",
        type=Path,
        required=True,
        metavar="FILE",
        help="YAML of ROS' camera_calibration or of BoofCV",
    )
    parser.add_argument(
        "--board", required=True, metavar="6x4", help="inner corners, along a row x rows"
    )
    positive = number(0.0, above=True)
    parser.add_argument(
        "--square", type=positive, required=True, metavar="M", help="side in metres"
    )
    parser.add_argument(
        "--rate", type=positive, required=True, metavar="HZ", help="images per second"
    )
    parser.add_argument(
        "--readout-time",
        type=number(0.0, settings()["readout_time"].maximum or 0.0),
        metavar="S",
        help="seconds from the first row to the last, if known: written to parameters.yaml beside "
        "the data, for replay --params",
    )
    parser.add_argument("--no-images", action="store_true", help="leave the images out")
    parser.add_argument("--out", type=Path, required=True, help="bag directory to create")
    args = parser.parse_args(arguments)
    try:
        columns, rows = (int(word) for word in args.board.split("x"))
    except ValueError:
        parser.error(f"--board must be of the form 6x4, got {args.board!r}")
    try:
        board = Board(columns, rows, args.square)
    except ValueError as error:
        parser.error(f"--board: {error}")
    try:
        recorded = record_board(
            args.video,
            read_calibration(args.calibration),
            board,
            args.out,
            rate=args.rate,
            with_images=not args.no_images,
        )
        if args.readout_time is not None:
            write_parameters(args.out, args.readout_time, ScanDirection.TOP_TO_BOTTOM.value)
    except (ValueError, OSError) as error:
        sys.stderr.write(f"{error}\n")
        return 1
    sys.stdout.write(
        f"{args.out}: {recorded.images - recorded.skipped} of {recorded.images} images, "
        f"{recorded.skipped} skipped because the board is cut off or not found; corners within "
        f"{recorded.residual:.3f} px rms of a global-shutter pose (median)\n"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
