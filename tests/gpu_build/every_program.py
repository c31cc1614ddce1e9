"""Builds every kernel that a GPU can be asked for, for GPUs of three makers: `make test-gpu-build`. Not collected by pytest.

    python tests/gpu_build/every_program.py [--table FILE]

What can be asked for is recorded, not listed: all methods and operators run on scans of a few pixels with a GPU's launch
shape, on whatever device there is, with float64 and without. Exit status 1 where a compiler refuses or a kernel spills.
"""

import argparse
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent / "oclgrind")]

from compilers import TARGETS, KernelCost, Refused, missing  # noqa: E402
from every_kernel import cases  # noqa: E402

from phyradgs_cl.runtime import Kernel, Runtime  # noqa: E402
from phyradgs_cl.runtime.opencl import kernel_source  # noqa: E402

_SMALL_FRAME_BYTES = 32  # of rays_forward on NVIDIA: the ends of a walk through the volume, not what a loop works on
# The values of B-splines, whose index depends on where the field ends. A work-item takes a Gaussian, not a pixel.
_TABLES_BYTES = {"splat_states": 200, "splat_states_back": 200}
Programs = dict[tuple[str, tuple[str, ...]], set[str]]
"""Names of the kernels that are launched, by program and options."""


def recorded(fp64: bool) -> Programs:
    """What all methods launch on a GPU that has float64, or not."""
    found: Programs = defaultdict(set)
    launch = Runtime.launch

    def noted(self: Runtime, kernel: Kernel, *args: object, **options: object) -> None:
        found[kernel.program, kernel.options].add(kernel.function_name)
        launch(self, kernel, *args, **options)  # type: ignore[arg-type]

    Runtime.launch = noted  # type: ignore[method-assign,assignment]
    try:
        rt = Runtime(lanes=1, pixel_items=True, fp64=fp64)
        for case in cases().values():
            case(rt)
    finally:
        Runtime.launch = launch  # type: ignore[method-assign]
    return found


def costs(programs: Programs, target: str) -> Iterator[tuple[str, list[KernelCost] | str]]:
    """(program with its defines, its kernels' costs, or a compiler's refusal) of one maker."""
    build = TARGETS[target][0]
    for (program, options), names in sorted(programs.items()):
        defines = " ".join(option.removeprefix("-D") for option in options if option.startswith("-D"))
        with tempfile.TemporaryDirectory() as folder:
            source = Path(folder) / f"{program}.cl"
            source.write_text(kernel_source(program), encoding="utf-8")
            try:
                built = build(source, options, Path(folder))
                yield f"{program} {defines}", [cost for cost in built if cost.kernel in names]
            except Refused as error:
                yield f"{program} {defines}", str(error)


def table(found: dict[str, dict[str, list[KernelCost]]]) -> str:
    """Markdown: per kernel and maker the worst of all defines."""
    kernels = sorted({kernel for by_kernel in found.values() for kernel in by_kernel})
    head = "| kernel | NVIDIA: registers, warps | AMD: registers, waves | Intel |"
    lines = [head, "|---" * (1 + len(found)) + "|"]
    for kernel in kernels:
        cells = [_worst(by_kernel.get(kernel, [])) for by_kernel in found.values()]
        lines.append(f"| `{kernel}` | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def placed(text: str, page: str) -> str:
    """A page with its table of kernels replaced by ``text``; the table alone where the page has none."""
    lines = page.splitlines(keepends=True)
    starts = [k for k, line in enumerate(lines) if line.startswith(text.partition("|---")[0].rstrip())]
    if not starts:
        return text
    stop = next((k for k in range(starts[0], len(lines)) if not lines[k].startswith("|")), len(lines))
    return "".join([*lines[: starts[0]], text, *lines[stop:]])


def _worst(costs_of_kernel: list[KernelCost]) -> str:
    registers = [cost.registers for cost in costs_of_kernel if cost.registers is not None]
    if not registers:
        return "builds"
    warps = min(cost.warps or 0 for cost in costs_of_kernel)
    local = max(cost.local_bytes or 0 for cost in costs_of_kernel)
    span = f"{min(registers)}–{max(registers)}" if min(registers) < max(registers) else str(registers[0])
    return f"{span}, {warps}" + (f", {local} B" if local else "")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--table", type=Path, help="file for the table, or a page that has it: docs/results/gpu.md")
    asked = parser.parse_args()
    if missing():
        print(f"not installed: {', '.join(missing())}; run make test-gpu-build", file=sys.stderr)
        return 1
    programs = {fp64: recorded(fp64) for fp64 in (True, False)}
    found: dict[str, dict[str, list[KernelCost]]] = {target: defaultdict(list) for target in TARGETS}
    bad = 0
    for target, (_, fp64) in TARGETS.items():
        for name, built in costs(programs[fp64], target):
            if isinstance(built, str):
                bad += 1
                print(f"{target} refuses {name}:\n{built[:2000]}", flush=True)
                continue
            for cost in built:
                found[target][cost.kernel].append(cost)
                bad += cost.spilled_bytes > _TABLES_BYTES.get(cost.kernel, _SMALL_FRAME_BYTES)
                print(
                    f"{cost.target}  {cost.kernel}  registers={cost.registers}  spilled={cost.spilled_bytes}  "
                    f"local={cost.local_bytes}  warps={cost.warps}  ({name})", flush=True,
                )  # fmt: skip
    text = table(found)
    if asked.table:
        page = asked.table.read_text(encoding="utf-8") if asked.table.exists() else ""
        asked.table.write_text(placed(text, page), encoding="utf-8")
    print(f"{len(programs[True])} programs for {', '.join(TARGETS)}: {bad} refused or with spills")
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
