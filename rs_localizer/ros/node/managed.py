"""A managed node with a worker: what the nodes of this package have in common.

Three threads: the executor's answers services, changes parameters and the life cycle, and publishes
diagnostics; that of the inputs takes messages; the worker's does the work and publishes.
"""

from __future__ import annotations

import functools
import traceback
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Generic, TypeVar

from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn

from rs_localizer.ros.node import parameters
from rs_localizer.ros.node.health import Diagnostics, Health
from rs_localizer.ros.node.inputs import Inputs, Silence, Topic
from rs_localizer.ros.node.lifecycle import RobustLifecycleNode
from rs_localizer.ros.node.refusals import Refusals, describe
from rs_localizer.ros.node.statistics import Statistics
from rs_localizer.ros.node.worker import State, Worker
from rs_localizer.settings import Config

Result = TypeVar("Result")
Told = TypeVar("Told")


class ManagedNode(RobustLifecycleNode, Generic[Config, State, Result, Told]):
    """Only while active it takes and publishes messages.

    A node says what it does by overriding :meth:`check`, :meth:`open`, :meth:`close`,
    :meth:`begin`, :meth:`end`, :meth:`change` and :meth:`examine`.

    Args:
        name: of the node.
        kind: class of its settings, which become its parameters.
        tell: stamp (ns) and what the statistics keep of a result.
        options: of rclpy's node.

    Raises:
        ValueError: when it is started with parameters that are refused, saying what was found.
    """

    task: ClassVar[str]  # in the name of the diagnosis
    lack: ClassVar[str]  # the notice of what it waits for
    checked_at_start: ClassVar[bool] = True
    faults: ClassVar[type[ValueError]] = ValueError  # of :meth:`open` that users can mend

    def __init__(
        self,
        name: str,
        kind: type[Config],
        tell: Callable[[Result], tuple[int, Told]],
        **options: Any,
    ) -> None:
        super().__init__(name, **options)
        self._kind: type[Config] = kind
        # From configuring to cleaning up.
        self.worker: Worker[State, Result] | None = None
        # From activating to deactivating.
        self._inputs: Inputs | None = None
        config = parameters.declare(self, kind)
        if self.checked_at_start:
            self.check(config)
        for text in parameters.unknown_names(self, kind):
            self.warn(f"a parameter is ignored: {text}")
        parameters.on_change(
            self, kind, check=self.check, apply=self.change, state=lambda: self.state
        )
        self.autostart: bool = config.autostart
        self.refusals = Refusals(self.warn)
        self.statistics: Statistics[Result, Told] = Statistics(
            self.refusals, tell, lambda: int(self.get_clock().now().nanoseconds)
        )
        self._diagnostics = Diagnostics(
            self, self.examine, self.refusals.notice, self.task, self.lack
        )

    # -- what a node does --------------------------------------------------------------------

    def check(self, config: Config) -> None:
        """Raise ``ValueError`` for settings that cannot be used."""
        raise NotImplementedError

    def open(self, config: Config) -> None:
        """Make what lives until :meth:`close`, the worker by :meth:`employ`.

        Raises:
            faults: when it cannot be configured so, saying why.
        """
        raise NotImplementedError

    def close(self) -> None:
        """Undo :meth:`open`, also where it failed half-way, or has not been called."""
        raise NotImplementedError

    def begin(self, config: Config) -> None:
        """The node is active: listen, and say so."""
        raise NotImplementedError

    def end(self) -> None:
        """Undo :meth:`begin` likewise, but for what it listens to."""
        raise NotImplementedError

    def change(self, config: Config) -> None:
        """Take settings that were accepted while the node runs."""
        raise NotImplementedError

    def examine(self) -> tuple[Health, str]:
        """For the diagnostics: how the node is, and the frame of its camera (or empty)."""
        raise NotImplementedError

    # -- what it has for that ----------------------------------------------------------------

    @property
    def config(self) -> Config:
        """The settings as the parameters are now."""
        config: Config = parameters.read(self, self._kind)
        return config

    @property
    def silence(self) -> dict[str, Silence]:
        """How it stands with each topic that is listened to."""
        return {} if self._inputs is None else self._inputs.silence()

    def employ(self, state: State, publish: Callable[[Result], None]) -> Worker[State, Result]:
        """Start the worker, which alone touches this state from now on."""
        self.worker = Worker(
            state,
            publish,
            self.statistics,
            functools.partial(self.refusals.add, "internal_error"),
        )
        return self.worker

    def listen(self, topics: Mapping[str, Topic]) -> list[str]:
        """Listen to these topics instead of those so far; their full names."""
        if self._inputs is not None:
            self._inputs.close()
            self._inputs = None
        if topics:
            self._inputs = Inputs(self, topics, self.refusals)
        return [] if self._inputs is None else self._inputs.topics

    def warn(self, text: str) -> None:
        self.get_logger().warning(text)

    # -- life cycle --------------------------------------------------------------------------

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            self.open(self.config)
        except self.faults as error:
            self.get_logger().error(f"not configured: {error}")
            self._close()
            return TransitionCallbackReturn.FAILURE
        except Exception:  # rclpy would hide it
            self.get_logger().error(f"not configured:\n{traceback.format_exc()}")
            self._close()
            return TransitionCallbackReturn.FAILURE
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        # Before a message can come: publishers that are not active yet drop what they are given.
        result = super().on_activate(state)
        try:
            self.begin(self.config)
        except Exception as error:  # rclpy would hide it; QoS overrides that make no QoS
            self.get_logger().error(f"not activated: {describe(error)}")
            self._end()
            super().on_deactivate(state)
            return TransitionCallbackReturn.FAILURE
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._end()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._close()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._end()
        self._close()
        return super().on_shutdown(state)

    def destroy_node(self) -> None:
        self._end()
        self._close()
        super().destroy_node()

    def _end(self) -> None:
        self.listen({})
        if self.worker is not None:
            self.worker.pause()
        self.end()

    def _close(self) -> None:
        if self.worker is not None:
            self.worker.close()
            self.worker = None
        self.close()
