"""What `make test` runs: rooms, files and single tests, by how their names begin. `make test-all` runs the others too."""

from pathlib import Path

HERE = Path(__file__).resolve().parent
QUICK = (
    # geometry to metrics, whole: values, closed forms, laws
    "acquisition/", "detector/", "fields/", "metrics/", "objective/", "optim/", "phantoms/", "simulation/",
    # every kernel against its twin
    "runtime/", "operators/", "laws/", "test_packed.py",
    # options of every method, the loop, the whole gradient, FDK, what a GPU would run
    "reconstructors/test_registry.py", "reconstructors/test_loop.py", "reconstructors/test_whole_objective.py",
    "reconstructors/test_fdk", "reconstructors/test_fbp.py", "reconstructors/test_gpu_shape.py",
    "reconstructors/test_without_pytorch.py", "reconstructors/test_missing_views.py::test_cells",
    "reconstructors/test_missing_views.py::test_a_displaced_panel_keeps_its_weights_where_views_are_missing[0.0",
    "calibrate/test_perturbed.py", "calibrate/test_beads.py::test_frames_are", "calibrate/test_beads.py::test_files_of",
    "check/test_plain_questions.py", "check/test_variants.py", "reconstructors/test_fits.py",
    "io/test_atomic.py", "io/test_checkpoint_file.py", "io/test_scan_round_trip.py", "io/test_volume_file.py",
    "io/test_deformation_file.py",
    *(f"prepare/test_each_step.py::test_{step}" for step in ("sparks", "dead", "air", "rings")),
    # every command; a kill and a resume; a full disk; mistakes in files of each kind
    "cli/test_smoke.py", "cli/test_settings.py", "cli/test_startup.py",
    "cli/test_kills.py::test_killed_runs_end_with_the_bits_of_one_that_was_not[phyradgs]",
    "faults/test_disk.py::test_no_room_at_any",
    "importers/test_refused.py", "io/test_scan_damaged.py::test_damage",
    "api/test_bad_input.py", "api/test_docstrings.py", "test_gate.py", "test_layers.py", "test_errors.py",
)  # fmt: skip
LATER = (
    "reconstructors/test_fdk_travel.py::test_long", "reconstructors/test_fdk_travel.py::test_with_a_pose",
    "reconstructors/test_fdk_travel.py::test_where",
    "operators/test_bricks.py", "operators/test_device_arrays.py", "acquisition/test_orbit_recipes.py",
    *(f"operators/test_subrays.py::test_{one}" for one in ("arrays_of", "a_volume_in", "an_object")),
    *(f"operators/test_splat_states.py::test_{one}" for one in ("frames_and_gradients", "parallel_rays")),
    "runtime/test_launches.py::test_groups", "importers/test_refused.py::test_a_mistake_is_named[nxtomo",
)  # fmt: skip
"""The same kernels on parts of volumes, arrays of the device, files by packages of `test-all`: with the slow tests."""


def is_quick(node: str) -> bool:
    """Whether a test, by its name from tests/ on, is one of them."""
    return node.startswith(QUICK) and not node.startswith(LATER)


def collects(file: str, expression: str) -> bool:
    """Whether a file, by its name from tests/ on, may have tests that this expression of ``-m`` chooses."""
    parts = [entry for entry in QUICK + LATER if "::" in entry and entry.startswith(file)]
    if expression == "quick":
        return is_quick(file) or bool(parts)
    return expression != "not quick" or not is_quick(file) or bool(parts)


def exists(entry: str) -> bool:
    """Whether there is a file, and a test in it, whose names begin like that: they may have been renamed."""
    file, _, test = entry.partition("::")
    word = f"def {test.partition('[')[0]}" if test else ""
    return any(
        path.relative_to(HERE).as_posix().startswith(file) and word in path.read_text(encoding="utf-8")
        for path in sorted(HERE.rglob("test_*.py"))
    )


assert all(map(exists, QUICK + LATER)), f"no such tests: {[entry for entry in QUICK + LATER if not exists(entry)]}"
