"""Settings of the nodes that look at images."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from rs_localizer.config.declared import check, setting
from rs_localizer.core.scanning import ScanDirection


class ImageTransport(StrEnum):
    """Which image topic a detector listens to."""

    AUTO = "auto"
    RAW = "raw"
    COMPRESSED = "compressed"


@dataclass(frozen=True, slots=True)
class DetectorConfig:
    """Settings of the marker detector."""

    marker_map: str = setting(
        "", "File of the marker map; rs_localizer markers make writes one with the prints"
    )
    min_side: float = setting(
        10.0,
        "Markers with a shorter side than this, in px, are left out",
        minimum=0.0,
        maximum=10000.0,
    )
    transport: str = setting(
        ImageTransport.AUTO.value,
        "Topic of the images; auto: image if it has a publisher, otherwise image/compressed",
        choices=tuple(transport.value for transport in ImageTransport),
        read_only=True,
    )
    readout_time: float = setting(
        0.0,
        "Only for the debug image: time from the first to the last row, in s, as the localizer's",
        minimum=0.0,
        maximum=0.2,
    )
    scan_direction: str = setting(
        ScanDirection.TOP_TO_BOTTOM.value,
        "Only for the debug image: direction in which the shutter moves, as the localizer's",
        choices=tuple(direction.value for direction in ScanDirection),
    )
    stamp_offset: float = setting(
        0.0,
        "Only for the debug image: time from header.stamp to the middle of the exposure of the "
        "first row, in s, as the localizer's",
        minimum=-10.0,
        maximum=10.0,
    )
    autostart: bool = setting(True, "Configure and activate the node at start", read_only=True)

    def __post_init__(self) -> None:
        check(self)


class FeatureKind(StrEnum):
    """How keypoints are found and described."""

    SIFT = "sift"
    ORB = "orb"
    AKAZE = "akaze"


@dataclass(frozen=True, slots=True)
class FeatureConfig:
    """Settings of the feature detector."""

    features: str = setting(
        FeatureKind.SIFT.value,
        "How keypoints are found and described; sift: as COLMAP does; it has to be the map's",
        choices=tuple(kind.value for kind in FeatureKind),
    )
    max_keypoints: int = setting(
        1000,
        "Most keypoints of an image: the best ones of all its parts",
        minimum=7,
        maximum=1_000_000,
    )
    transport: str = setting(
        ImageTransport.AUTO.value,
        "Topic of the images; auto: image if it has a publisher, otherwise image/compressed",
        choices=tuple(transport.value for transport in ImageTransport),
        read_only=True,
    )
    autostart: bool = setting(True, "Configure and activate the node at start", read_only=True)

    def __post_init__(self) -> None:
        check(self)
