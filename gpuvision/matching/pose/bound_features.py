"""Features of a board bound to a device and a frame size: a frame and an expected pose in, the camera's pose out."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from numpy.typing import DTypeLike

from gpuvision.host import BoundSequence, Device, host_view
from gpuvision.host.arrays import check_host
from gpuvision.matching.pose.feature_pose import EstimateFeaturePose, FeaturePose


class BoundFeatures:
    """Features bound to a device and a frame size: ``bound(frame, predicted_pose) -> FeaturePose``.

    A call allocates nothing, compiles nothing, and copies nothing but the frame. For one thread.

    Parameters
    ----------
    operation : EstimateFeaturePose
    device : Device
    shape : (int, int)
        Rows and columns of a frame.
    dtype : dtype
        uint8, uint16 or float32.
    queue : pyopencl.CommandQueue, optional
        None: a queue that runs in the calling thread where the device has such queues, because waking other threads
        takes longer than the work of a core.

    Attributes
    ----------
    operation : EstimateFeaturePose
    stages : mapping of str to Bound
        Bound operations; their outputs have the edges along the rulers and the blobs.
    frame : numpy.ndarray
        Memory of the frame: a camera may write it directly, with ``bound(None, predicted_pose)`` after it.
    """

    def __init__(
        self,
        operation: EstimateFeaturePose,
        device: Device,
        shape: tuple[int, int],
        dtype: DTypeLike,
        queue: Any = None,
    ) -> None:
        self.operation, self.device = operation, device
        queue = device.new_queue(inline=device.has_inline_queues) if queue is None else queue
        bound = operation.bind(device, shape, dtype, queue=queue)
        assert isinstance(bound, BoundSequence)
        self.stages = bound.stages
        self._bound: BoundSequence[FeaturePose] = bound
        self._shares = device.shares_memory
        self.frame, self._pose, self._corner = map(self._host_memory, bound.inputs)
        self._result = FeaturePose(*(self._host_memory(array) for array in bound.outputs))

    def _host_memory(self, array: Any) -> npt.NDArray[Any]:
        return host_view(array) if self._shares else np.zeros(array.shape, array.dtype)

    def __call__(
        self,
        frame: npt.NDArray[Any] | None,
        predicted_pose: npt.ArrayLike,
        corner: tuple[float, float] = (0.0, 0.0),
    ) -> FeaturePose:
        """Measure the features where a camera at the predicted pose sees them, and solve the camera's pose.

        Parameters
        ----------
        frame : numpy.ndarray or None
            Frame of the bound shape and dtype; None: the frame is in the memory `frame`.
        predicted_pose : array_like, (3,)
            x, y [m]: point of the artwork at the middle of the full image; theta [rad]: direction in which the columns
            increase.
        corner : (float, float)
            Column and row of the frame's first pixel in the full image [px]. Default ``(0.0, 0.0)``.

        Returns
        -------
        FeaturePose
            NumPy arrays; the next call overwrites them.

        Raises
        ------
        TypeError, ValueError
            Dtype, shape or layout of the frame differ from the bound dtype, shape or layout.
        """
        if frame is not None:
            check_host(frame, self.frame.shape, self.frame.dtype, "frame")
            self.frame[...] = frame
        self._pose[:] = predicted_pose
        self._corner[:] = corner
        if not self._shares:
            return self._bound.on_host((self.frame, self._pose, self._corner), self._result)
        self.device.wait(self._bound())
        return self._result
