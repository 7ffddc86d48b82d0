"""What was measured, in words and tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

Row = Mapping[str, Any]


def about(hardware: Row, versions: Row) -> str:
    """The machine in a few words."""
    words = [hardware["cpu"], f"{hardware['cores']} cores", f"{hardware['threads']} threads"]
    return ", ".join([*words, *([hardware["gpu"]] if "gpu" in hardware else []), f"torch {versions['torch']}"])


def name(row: Row) -> str:
    """What a row measures."""
    precision = "" if row["precision"] == "32" else ", bf16"
    products = "" if row.get("matmul_precision") in (None, "highest") else f", matmul {row['matmul_precision']}"
    return f"{row['device']}, {row['mode']}{precision}{products}, {row['what']}"


def line(row: Row) -> str:
    """One row in a sentence."""
    if row["unavailable"] is not None:
        return f"{name(row)}: {row['unavailable']}"
    low, high = row["frames_per_second_min_max"]
    words = [
        f"{name(row)}: {_speed(row['frames_per_second'])} frames/s ({_speed(low)} to {_speed(high)})",
        f"batch {_batch(row)}",
        f"peak memory {_memory(row['peak_memory_gib'])}",
    ]
    if "graph_breaks" in row:
        words.append(f"{row['graph_breaks']} graph breaks, compiled in {row['setup_seconds']:.0f} s")
    if "kernels" in row:
        words.append(f"{row['kernels']} kernels, {row['launches']} launches")
    return ", ".join(words)


def whole_batch(row: Row) -> str:
    """Peak memory of a training step on the whole batch."""
    return f"cpu, training step on {_batch(row)}: peak memory {_memory(row['peak_memory_gib'])}, {row['seconds']:.1f} s"


def comparison(compared: Row) -> str:
    """The model against each naive twin, a sentence each."""
    said = []
    for variant, found in compared["models"].items():
        if variant == "model":
            continue
        low, high = found["times_min_max"]
        both = [_speed(compared["models"][model]["frames_per_second"]) for model in ("model", variant)]
        said.append(
            f"{compared['device']}: trains {found['model_trains_times_as_many']:.2f} times as many frames/s as "
            f'the naive twin "{variant}" ({low:.2f} to {high:.2f}; {" and ".join(both)}; '
            f"batch {compared['batch_size']} x {compared['frames']} frames"
            + ("" if (of := found["times_in_processor_time"]) is None else f"; {of:.2f} in processor time")
            + ")"
        )
    return "\n".join(said)


def tables(rows: Sequence[Row]) -> list[str]:
    """All rows, then seconds by part and share of the matrix-product rate of those that have parts.

    The seconds of the second table are by the clock and under the profiler; those of the third are what its shares are
    computed from.
    """
    measured = [row for row in rows if row["unavailable"] is None]
    header = ["", "frames/s", "seconds", "peak memory"]
    lines = [
        [name(row), _speed(row["frames_per_second"]), f"{row['seconds']:.3f}", _memory(row["peak_memory_gib"])]
        for row in measured
    ]
    made = [_table([header, *lines])] if lines else []
    by_part = [row for row in measured if "parts" in row]
    if by_part:
        names = list(dict.fromkeys(part for row in by_part for part in row["parts"]))
        lines = [
            [part, *(f"{row['parts'][part]:.3f}" if part in row["parts"] else "" for row in by_part)] for part in names
        ]
        total = ["sum", *(f"{sum(row['parts'].values()):.3f}" for row in by_part)]
        made.append(_table([["seconds by part, by the clock", *(name(row) for row in by_part)], *lines, total]))
        made.append(_arithmetic(by_part))
    return made


def _arithmetic(rows: Sequence[Row]) -> str:
    """FLOPs by part, the seconds they took, and the rate, also as a share of that of a plain matrix product.

    A line can be recomputed from itself: GFLOP / seconds = GFLOP/s = share x the rate below.
    """
    found = [row["arithmetic"] for row in rows]
    header = ["GFLOP / seconds (a CPU's: processor's) = GFLOP/s, share of the rate", *(name(row) for row in rows)]
    names = list(dict.fromkeys(part for of in found for part in of["flops"]))
    keys = ("flops", "counted_seconds", "rates", "shares")
    lines = [
        [part, *(_work(*(of[key][part] for key in keys)) if part in of["flops"] else "" for of in found)]
        for part in names
    ]
    total = ["all"]
    for of in found:
        flops, seconds = sum(of["flops"].values()), sum(of["counted_seconds"].values())
        total.append(_work(flops, seconds, of["rate"], of["share"]))
    rate = ["the rate of a matrix product in GFLOP/s", *(f"{of['matrix_rate'] / 1e9:.4g}" for of in found)]
    return _table([header, *lines, total, rate])


def _work(flops: float, seconds: float, rate: float, share: float) -> str:
    return f"{flops / 1e9:.4g} / {seconds:.4g} = {rate / 1e9:.4g}, {share:.1%}"


def _table(lines: Sequence[Sequence[str]]) -> str:
    widths = [max(len(line[i]) for line in lines) for i in range(len(lines[0]))]
    return "\n".join(
        "  ".join(
            [row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))]
        )
        for row in lines
    )


def _batch(row: Row) -> str:
    return f"{row['batch_size']} x {row['frames']} frames of {row['image_size']} x {row['image_size']}"


def _memory(gib: float | None) -> str:
    return "not known on this system" if gib is None else f"{gib:.2f} GiB"


def _speed(frames: float) -> str:
    return f"{frames:.3g}" if frames < 100 else f"{frames:,.0f}"
