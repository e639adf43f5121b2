"""Sphinx extension: one page for every public name of gpuvision, and one index page for every package.

Documented are the names of ``gpuvision.__all__`` and ``gpuvision.host.__all__``, the modules of `MODULES`, and the
types of gpuvision that their signatures mention, such as the results of functions. A name appears under the package
that defines it. A package without a title in `PACKAGES` is an error: it would be missing from the index.

A name in single backticks in a docstring links to its page, written in full or not.
"""

from __future__ import annotations

import importlib
import inspect
import re
import typing
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gpuvision
import gpuvision.host
from pages import table, title, toctree, write_pages

FOLDER = "reference/api"

# Packages in the order of the index: title and contents.
PACKAGES = {
    "host": ("Devices, operations and streams", "Choose an OpenCL device, run an operation, stream frames through it."),
    "status": ("Status flags", "Reasons why a value is missing or doubtful."),
    "ranging": (
        "Range imaging",
        "Read the position of a laser line or a light spot, triangulate it, and assemble range images.",
    ),
    "camera": (
        "Cameras and lenses",
        "Detect calibration targets, calibrate lenses and tilted (Scheimpflug) cameras, undo distortion.",
    ),
    "matching": (
        "Matching and pose estimation",
        "Measure edges along calipers (rulers), find fiducials, fit lines, and solve for the pose of a board or robot.",
    ),
    "inspection": (
        "Inspection",
        "Measure solder paste and the coplanarity of leads in height maps, with standard deviations.",
    ),
    "simulation": (
        "Simulation",
        "Predict what a sheet-of-light sensor measures over a part: occlusion, reflectance, interreflection, noise.",
    ),
    "servoing": (
        "Visual servoing",
        "Steer a head by its camera: frames, calibration of the machine, delay, control, and the placement of parts.",
    ),
    "accuracy": ("Speed and accuracy", "Plans: the fastest settings of a job that meet a tolerance."),
    "sensor": ("Sensors", "A sensor as its description file states it: readout, light source, simulated twin."),
    "formats": ("Files", "Read and write sensor, lens, field, feature and material files, and range images."),
    "plots": ("Pictures", "Scales of the pictures that simulations write."),
    "workflows": ("Workflows", "Whole jobs on files, called by the commands of ``gpuvision``."),
    "reference": (
        "Float64 references",
        "Independent versions of the operations in NumPy and SciPy, to check a device with.",
    ),
    "operation": ("Operations of your own", "The kernel folder and the option types that the operations share."),
}

# Public modules beyond the exported names: one page each.
MODULES = (
    "gpuvision.operation",
    "gpuvision.ranging.focus",
    "gpuvision.ranging.focus_noise",
    "gpuvision.ranging.focus_stack",
    "gpuvision.ranging.line_phase",
    "gpuvision.ranging.polygon",
    "gpuvision.ranging.polygon_scan",
    "gpuvision.ranging.encoder",
    "gpuvision.camera.calibration",
    "gpuvision.camera.photon_transfer",
    "gpuvision.camera.photons",
    "gpuvision.camera.sensor_readout",
    "gpuvision.camera.ground_plane",
    "gpuvision.camera.orthographic",
    "gpuvision.simulation.errors.recommendations",
    "gpuvision.simulation.errors.resampling",
    "gpuvision.simulation.errors.sensor_fusion",
    "gpuvision.simulation.errors.sensor_pair",
    "gpuvision.reference.blob",
    "gpuvision.reference.board_image",
    "gpuvision.reference.camera",
    "gpuvision.reference.deposits",
    "gpuvision.reference.field",
    "gpuvision.reference.light_clustering",
    "gpuvision.reference.line",
    "gpuvision.reference.line_irradiance",
    "gpuvision.reference.mirrors",
    "gpuvision.reference.occluded_irradiance",
    "gpuvision.reference.patches",
    "gpuvision.reference.plane_polynomial",
    "gpuvision.reference.psd",
    "gpuvision.reference.radiosity",
    "gpuvision.reference.range_image",
    "gpuvision.reference.rays",
    "gpuvision.reference.registration",
    "gpuvision.reference.regrid",
    "gpuvision.reference.robust",
    "gpuvision.reference.ruler",
    "gpuvision.reference.sheet",
    "gpuvision.reference.triangulation",
    "gpuvision.reference.undistort_image",
    "gpuvision.reference.visible_intervals",
    "gpuvision.accuracy.plan",
    "gpuvision.accuracy.trial",
    "gpuvision.servoing.frames",
    "gpuvision.servoing.machine_calibration.calibrated_plant",
    "gpuvision.servoing.machine_calibration.camera_frame",
    "gpuvision.servoing.machine_calibration.motion_frame",
    "gpuvision.servoing.machine_calibration.next_measurement",
    "gpuvision.servoing.machine_calibration.nozzle_axis",
    "gpuvision.servoing.placement.budget",
    "gpuvision.servoing.placement.machine",
    "gpuvision.servoing.placement.placing",
    "gpuvision.servoing.placement.plan",
    "gpuvision.servoing.placement.vision",
    "gpuvision.sensor.light_source",
    "gpuvision.sensor.sensor",
    "gpuvision.formats.camera_file",
    "gpuvision.formats.cmos_sensor_file",
    "gpuvision.formats.features_file",
    "gpuvision.formats.field_file",
    "gpuvision.formats.height_files",
    "gpuvision.formats.leads_file",
    "gpuvision.formats.loop_recording",
    "gpuvision.formats.machine_file",
    "gpuvision.formats.materials_file",
    "gpuvision.formats.range_image",
    "gpuvision.formats.surface_files",
    "gpuvision.inspection.alignment",
    "gpuvision.inspection.aperture_cells",
    "gpuvision.inspection.apertures",
    "gpuvision.inspection.coplanarity",
    "gpuvision.inspection.deposits",
    "gpuvision.inspection.height_noise",
    "gpuvision.inspection.paste",
    "gpuvision.inspection.phase_sigmas",
    "gpuvision.inspection.reference_surface",
    "gpuvision.inspection.top_height",
    "gpuvision.servoing.axis",
    "gpuvision.servoing.controllers",
    "gpuvision.servoing.delay",
    "gpuvision.servoing.delay_measurement",
    "gpuvision.servoing.delay_response",
    "gpuvision.servoing.guard",
    "gpuvision.servoing.loop",
    "gpuvision.servoing.low_latency",
    "gpuvision.servoing.margins",
    "gpuvision.servoing.observer",
    "gpuvision.servoing.plant",
    "gpuvision.servoing.settling",
    "gpuvision.servoing.simulated_sensor",
    "gpuvision.workflows.analysing_delay",
    "gpuvision.workflows.calibrating",
    "gpuvision.workflows.calibrating_sensor",
    "gpuvision.workflows.inspecting_leads",
    "gpuvision.workflows.inspecting_paste",
    "gpuvision.workflows.locating_board",
    "gpuvision.workflows.locating_part",
    "gpuvision.workflows.locating_robot",
    "gpuvision.workflows.placing",
    "gpuvision.workflows.scan_result",
    "gpuvision.workflows.scanning",
    "gpuvision.workflows.sensor_calibration_result",
    "gpuvision.workflows.sensor_pair",
    "gpuvision.workflows.simulating",
    "gpuvision.workflows.undistorting",
)


def public_names() -> dict[str, Any]:
    """Return the exported objects, by the name under which a user imports each."""
    names = {f"gpuvision.{name}": getattr(gpuvision, name) for name in gpuvision.__all__}
    host = {f"gpuvision.host.{name}": getattr(gpuvision.host, name) for name in gpuvision.host.__all__}
    return names | {name: value for name, value in host.items() if name.rpartition(".")[2] not in gpuvision.__all__}


def documented_names() -> dict[str, Any]:
    """Return everything that has a page: exported objects, modules, and the types in their signatures."""
    found = public_names() | {name: importlib.import_module(name) for name in MODULES}
    known = {id(value) for value in found.values()}
    waiting = list(found.values())
    while waiting:
        for each in _mentioned(waiting.pop()):
            if id(each) not in known and each.__module__ not in MODULES:
                known.add(id(each))
                waiting.append(each)
                found[f"{each.__module__}.{each.__qualname__}"] = each
    return found


def _mentioned(value: Any) -> Iterator[type]:
    """Yield the public classes of gpuvision in the annotations of an object and of its public methods."""
    parts = [value]
    if inspect.ismodule(value):
        parts = [each for each in vars(value).values() if getattr(each, "__module__", None) == value.__name__]
    for part in parts:
        inside = vars(part).items() if inspect.isclass(part) else ()
        members = [each for name, each in inside if name[0] != "_" or name in ("__init__", "__call__")]
        for base in (*getattr(part, "__orig_bases__", ()), *getattr(part, "__bases__", ())):
            yield from _classes_in(base)
        for each in (part, *members):
            for wrapper in ("__func__", "fget", "func"):  # class methods, properties, cached properties
                each = getattr(each, wrapper, each)
            try:
                hints = typing.get_type_hints(each)
            except (TypeError, NameError):  # no annotations, or annotations for type checkers only
                continue
            for name, hint in hints.items():
                if not name.startswith("_"):
                    yield from _classes_in(hint)


def _classes_in(hint: Any) -> Iterator[type]:
    bare = typing.get_origin(hint) or hint
    if inspect.isclass(bare):
        package, _, inside = bare.__module__.partition(".")
        if package == "gpuvision" and inside.partition(".")[0] in PACKAGES and not bare.__name__.startswith("_"):
            yield bare
    for each in typing.get_args(hint):
        yield from _classes_in(each)


def _package_of(name: str, value: Any) -> str:
    """Return the package, below ``gpuvision``, that defines an object."""
    module = name if inspect.ismodule(value) else getattr(value, "__module__", "") or name.rpartition(".")[0]
    if not module.startswith("gpuvision."):
        module = name.rpartition(".")[0]  # an alias of a type of another library
    package = module.split(".")[1]
    if package not in PACKAGES:
        raise ValueError(f"{name} is defined in gpuvision.{package}, which has no title in PACKAGES of {__file__}")
    return package


def _first_line(value: Any) -> str:
    if not (inspect.ismodule(value) or inspect.isclass(value) or inspect.isroutine(value)):
        return "Type alias."
    return (inspect.getdoc(value) or "").partition("\n")[0]


def _object_page(name: str, value: Any, documented: dict[str, Any]) -> str:
    """Return the page of one object."""
    if inspect.ismodule(value):
        pages = {id(each) for each in documented.values()}
        elsewhere = [each for each, member in vars(value).items() if id(member) in pages]
        without = f"   :exclude-members: {', '.join(elsewhere)}\n" if elsewhere else ""
        return f"{title(name)}\n.. automodule:: {name}\n   :members:\n   :member-order: bysource\n{without}"
    head = title(name.rpartition(".")[2])
    if inspect.isclass(value):
        options = "   :members:\n   :exclude-members: Result\n   :show-inheritance:\n   :member-order: bysource\n"
        # A class that is split over modules has the members of its parts, up to the first other base.
        others = [each for each in value.__mro__[1:] if not each.__module__.startswith(f"{value.__module__}_")]
        if others[0] not in value.__bases__[:1]:
            options += f"   :inherited-members: {others[0].__name__}\n"
        return f"{head}\n.. autoclass:: {name}\n{options}"
    if inspect.isroutine(value):
        return f"{head}\n.. autofunction:: {name}\n"
    return f"{head}\n.. py:type:: {name}\n\n   ``{value}``\n"


def api_pages() -> dict[str, str]:
    """Return all pages by file name."""
    documented, exported = documented_names(), public_names()
    pages = {f"{name}.rst": _object_page(name, value, documented) for name, value in documented.items()}
    groups: dict[str, list[str]] = defaultdict(list)
    for name, value in documented.items():
        groups[_package_of(name, value)].append(name)
    for package, names in groups.items():
        names.sort(key=str.lower)
        parts = [title(PACKAGES[package][0]), f"{PACKAGES[package][1]}\n"]
        kinds: dict[str, Callable[[str], bool]] = {
            "Exported names": lambda name: name in exported,
            "Modules": lambda name: name in MODULES,
            "Types in signatures": lambda name: name not in exported and name not in MODULES,
        }
        for heading, belongs in kinds.items():
            rows = [
                (f":doc:`{name.removeprefix('gpuvision.')} <{name}>`", _first_line(documented[name]))
                for name in names
                if belongs(name)
            ]
            if rows:
                parts += [title(heading, "-"), table(("name", "summary"), rows)]
        pages[f"package-{package}.rst"] = "\n".join((*parts, toctree(names)))
    listed = [package for package in PACKAGES if package in groups]
    pages["index.rst"] = "\n".join(
        (
            title("API reference"),
            "Import exported names as ``import gpuvision as gv``, and names of ``gpuvision.host`` from there.\n",
            table(
                ("package", "contents"),
                [(f":doc:`{PACKAGES[each][0]} <package-{each}>`", PACKAGES[each][1]) for each in listed],
            ),
            toctree(f"package-{each}" for each in listed),
        )
    )
    return pages


class OtherNames:
    """Links for names as docstrings and annotations use them: ``Lens``, ``Lens.undistort``, ``package.module.Lens``."""

    def __init__(self) -> None:
        self._full: dict[str, str] = {}

    def _read(self, objects: Any) -> None:
        """Index the documented objects by the end of their names; ambiguous ends are omitted."""
        ends: dict[str, set[str]] = defaultdict(set)
        for name, entry in objects.items():
            # References have the names of the operations that they check; only their full names are linked.
            if not entry.aliased and not name.startswith("gpuvision.reference."):
                parts = name.split(".")
                for start in range(1, len(parts)):
                    ends[".".join(parts[start:])].add(name)
        self._full = {end: next(iter(names)) for end, names in ends.items() if len(names) == 1}
        for name, value in public_names().items():
            if inspect.isroutine(value):
                self._full[f"{value.__module__}.{value.__qualname__}"] = name

    def resolve(self, app: Any, env: Any, node: Any, content: Any) -> Any:
        """Return the link for a reference of the Python domain that Sphinx did not find, or None."""
        if node.get("refdomain") != "py":
            return None
        domain = env.domains.python_domain
        if not self._full:
            self._read(domain.objects)
        full = self._full.get(node["reftarget"])
        if full is None:
            return None
        return domain.resolve_xref(env, node["refdoc"], app.builder, "obj", full, node, content)


_NDARRAY = re.compile(
    r"~?numpy\.ndarray\[tuple\[~?typing\.Any, \.\.\.\], ~?numpy\.dtype\[~?(?:\w+\.)*(\w+)(?:\[~?typing\.Any\])?\]\]"
)


def shorten_arrays(app: Any, what: str, name: str, value: Any, options: Any, signature: str, returns: str) -> Any:
    """Return signature and return type with the short form ``NDArray[float64]`` of array types."""
    texts = (None if each is None else _NDARRAY.sub(r"NDArray[\1]", each) for each in (signature, returns))
    return tuple(texts)


def skip_fields(app: Any, what: str, name: str, value: Any, skip: bool, options: Any) -> bool | None:
    """Skip the fields of a named tuple: its docstring lists them, and the fields have generated docstrings."""
    return True if type(value).__name__ == "_tuplegetter" else None


def setup(app: Any) -> dict[str, Any]:
    """Write the pages before Sphinx looks for documents."""
    names = OtherNames()
    app.connect("config-inited", lambda app, config: write_pages(Path(app.srcdir, FOLDER), api_pages()))
    app.connect("autodoc-process-signature", shorten_arrays)
    app.connect("autodoc-skip-member", skip_fields)
    app.connect("missing-reference", names.resolve)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
