"""What is fed to the worker of the localizer node: frames, and all that says how to localize them.

Messages come in the thread of the inputs, settings and requests in the executor's. What is no frame
becomes an update, which the worker's thread carries out between two frames.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from typing import Any

from rclpy.serialization import deserialize_message

from rs_localizer.config import ImuUse, NodeConfig
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.io.messages import MessageError, stamp_ns
from rs_localizer.io.outputs import Localized
from rs_localizer.pipeline.compiling import compile_in_child
from rs_localizer.pipeline.frames import FrameLocalizer
from rs_localizer.pipeline.inputs import INPUTS, Input, Role
from rs_localizer.pipeline.refusal import Refusal
from rs_localizer.ros.node.conversion import message_class
from rs_localizer.ros.node.inputs import FAST_DATA, LATCHED, SENSOR_DATA, Topic
from rs_localizer.ros.node.refusals import Refusals
from rs_localizer.ros.node.worker import Need, Worker

# In a serialized message, which begins with four bytes of CDR and the stamp of its header.
_AFTER_STAMP = 12
# A change of settings that takes longer (s) has compiled kernels, and says so.
_LONG_CHANGE = 0.5


class Feed:
    """Reads messages where they come, so that a bad one never takes the place of a good one.

    Args:
        worker: gets frames and updates.
        frames: that of the worker, here only to be read.
        refusals: told of messages that cannot be used.
        say: takes a line for the log.
        needs_tf: called once when readings come whose axes are not the camera's.
    """

    def __init__(
        self,
        worker: Worker[FrameLocalizer, Localized],
        frames: FrameLocalizer,
        refusals: Refusals,
        say: Callable[[str], Any],
        needs_tf: Callable[[], None] = lambda: None,
    ) -> None:
        self._worker = worker
        self._frames = frames
        self._refusals = refusals
        self._say = say
        self._needs_tf: Callable[[], None] | None = needs_tf
        # The last that was handed on of what is repeated, and what it says; by topic.
        self._repeated: dict[str, tuple[bytes, Any]] = {}
        self.changing = False  # whether the worker compiles kernels for new settings

    def topics(self) -> dict[str, Topic]:
        """The inputs; what changes the state comes before the frames."""
        make = {
            Role.FRAMES: self._frames_topic,
            Role.STATE: self._state_topic,
            Role.SAMPLES: self._samples_topic,
        }
        return {name: make[item.role](item) for name, item in INPUTS.items()}

    def take_config(self, config: NodeConfig) -> None:
        """Use these settings from the next frame on."""
        self._worker.update("settings", lambda frames: self._change(frames, config))

    def reset(self) -> None:
        """Forget the previous frames."""
        self._worker.update("reset", FrameLocalizer.reset)

    # -- in the thread of the inputs ---------------------------------------------------------

    def _frames_topic(self, item: Input) -> Topic:
        """A topic whose messages the worker localizes."""

        def localize(frames: FrameLocalizer, message: Any) -> Localized | Refusal:
            result = item.take(frames, message)
            assert result is not None  # a frame has one
            return result

        def take(message: Any) -> None:
            need = Need(_lacks_samples, self._frames.config.imu.wait)
            self._worker.process(item.topic, message, localize, need)

        return Topic(message_class(item.type), take)

    def _samples_topic(self, item: Input) -> Topic:
        """A topic whose messages are all used here; frames wait for them."""
        take = functools.partial(self._take_sample, item)
        return Topic(message_class(item.type), take, FAST_DATA, raw=True)

    def _take_sample(self, item: Input, serialized: bytes) -> None:
        if self._frames.config.imu.use == ImuUse.NONE:
            return
        message = deserialize_message(serialized, message_class(item.type))
        refusal = item.take(self._frames, message)
        if isinstance(refusal, Refusal):
            self._refusals.add(refusal.reason, refusal.detail)
            return
        self._worker.look()
        if self._needs_tf is not None and self._frames.imu.frame != self._frames.camera_frame:
            self._needs_tf()
            self._needs_tf = None

    def _state_topic(self, item: Input) -> Topic:
        """A topic whose messages are read here; the worker uses them."""
        return Topic(
            message_class(item.type),
            functools.partial(self._take if item.held is None else self._take_repeated, item),
            LATCHED if item.latched else SENSOR_DATA,
            lasting=item.lasting,
            raw=item.held is not None,
        )

    def _take(self, item: Input, message: Any) -> Any:
        """What the message says, which the worker will use; None if it cannot be read."""
        try:
            content = item.read(message)
        except MessageError as error:
            self._refusals.add(item.refused, str(error))
            return None
        self._worker.update(item.topic, lambda frames: self._use(frames, item, content))
        return content

    def _take_repeated(self, item: Input, serialized: bytes) -> None:
        # Drivers repeat it with every image, and only its stamp is new.
        assert item.held is not None
        rest = serialized[_AFTER_STAMP:]
        last, said = self._repeated.get(item.topic, (b"", None))
        if rest == last and said == item.held(self._frames):
            return
        content = self._take(item, deserialize_message(serialized, message_class(item.type)))
        if content is not None:
            self._repeated[item.topic] = rest, content

    # -- in the worker's thread, between two frames ------------------------------------------

    def _use(self, frames: FrameLocalizer, item: Input, content: Any) -> None:
        before = frames.map
        try:
            item.use(frames, content)
        except MessageError as error:
            self._refusals.add(item.refused, str(error))
        if frames.map is not None and frames.map is not before:
            self._say(described(frames.map))

    def _change(self, frames: FrameLocalizer, config: NodeConfig) -> None:
        self.changing = True
        try:
            frames.config = config
            seconds = warm_up(frames)
        finally:
            self.changing = False
        if seconds > _LONG_CHANGE:
            self._say(f"kernels for the new settings are ready after {seconds:.1f} s")


def _lacks_samples(frames: FrameLocalizer, message: Any) -> bool:
    return frames.awaits_imu(stamp_ns(message), frames.config.imu.wait)


def described(landmarks: Map) -> str:
    """A map in one line."""
    return f"the map has {len(landmarks)} landmarks in frame {landmarks.frame!r}"


def warm_up(frames: FrameLocalizer) -> float:
    """Compile all kernels that the settings need; how many seconds it took."""
    started = time.monotonic()
    compile_in_child(frames.config.solver)
    frames.warm_up()
    return time.monotonic() - started
