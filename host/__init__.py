"""Run kernels: find devices, build programs, bind operations, stream frames. Knows no vision."""

from gpuvision.host import cache as cache  # before pyopencl is imported: it checks the cache folder's variable

# isort: split
from gpuvision.host.arrays import (
    Array,
    DeviceArray,
    FitStatusArray,
    FloatArray,
    HostArray,
    IntArray,
    StatusArray,
    host_view,
    to_numpy,
)
from gpuvision.host.batch import Batch
from gpuvision.host.bound import Bound
from gpuvision.host.device import Device
from gpuvision.host.device_choice import DeviceChoice, StepDevices, fastest_device
from gpuvision.host.errors import (
    BuildError,
    DeviceLimitError,
    DeviceLostError,
    DeviceMemoryError,
    DeviceUnusableError,
    GpuVisionError,
    NoDeviceError,
    ReadError,
    RecordingError,
    StreamError,
)
from gpuvision.host.kept import clear_cache
from gpuvision.host.launch import (
    Launch,
    Precision,
    Spec,
    Specs,
    Variant,
    real_defines,
    real_of,
    two_floats,
    uses_vectors,
)
from gpuvision.host.launch_builder import LaunchBuilder, flags, opencl_type, table_offsets, type_defines
from gpuvision.host.operation import Operation
from gpuvision.host.pipeline import Pipeline, PipelineLimits
from gpuvision.host.planning import Plan, PlanLimits, plan_stream
from gpuvision.host.program import Define
from gpuvision.host.reading import FileLimit
from gpuvision.host.recordings import open_recording
from gpuvision.host.report import StreamReport
from gpuvision.host.ring import Step
from gpuvision.host.sequence import BoundSequence, Layout, OperationSequence, Stage
from gpuvision.host.sources import ArraySource, PacedSource, Source
from gpuvision.host.stalls import Stall
from gpuvision.host.trace import Trace
from gpuvision.host.tuned_settings import Tunable
from gpuvision.host.work_size import (
    WorkSize,
    capacity,
    ceil_div,
    fitted_groups,
    group_per_element,
    padded_groups,
    padded_rows,
    round_up,
    strided_groups,
    vector_work,
)

__all__ = [
    "Array",
    "ArraySource",
    "Batch",
    "Bound",
    "BoundSequence",
    "BuildError",
    "Define",
    "Device",
    "DeviceArray",
    "DeviceChoice",
    "DeviceLimitError",
    "DeviceLostError",
    "DeviceMemoryError",
    "DeviceUnusableError",
    "FileLimit",
    "FitStatusArray",
    "FloatArray",
    "GpuVisionError",
    "HostArray",
    "IntArray",
    "Launch",
    "LaunchBuilder",
    "Layout",
    "NoDeviceError",
    "Operation",
    "OperationSequence",
    "PacedSource",
    "Pipeline",
    "PipelineLimits",
    "Plan",
    "PlanLimits",
    "Precision",
    "ReadError",
    "RecordingError",
    "Source",
    "Spec",
    "Specs",
    "Stage",
    "Stall",
    "StatusArray",
    "Step",
    "StepDevices",
    "StreamError",
    "StreamReport",
    "Trace",
    "Tunable",
    "Variant",
    "WorkSize",
    "capacity",
    "ceil_div",
    "clear_cache",
    "fastest_device",
    "fitted_groups",
    "flags",
    "group_per_element",
    "host_view",
    "open_recording",
    "opencl_type",
    "padded_groups",
    "padded_rows",
    "plan_stream",
    "real_defines",
    "real_of",
    "round_up",
    "strided_groups",
    "table_offsets",
    "to_numpy",
    "two_floats",
    "type_defines",
    "uses_vectors",
    "vector_work",
]
