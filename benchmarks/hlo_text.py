"""Optimised HLO as text: its operations, and the bytes that each kernel reads and writes. For ``gpu_aot.py``."""

import collections
import dataclasses
import re

SIZES = {"pred": 1, "s8": 1, "u8": 1, "bf16": 2, "f16": 2, "s16": 2, "u16": 2, "f32": 4, "s32": 4, "u32": 4}
SIZES |= {"f64": 8, "s64": 8, "u64": 8, "c64": 8, "c128": 16}


@dataclasses.dataclass
class Op:
    name: str
    shape: str
    opcode: str
    operands: list
    attributes: str
    root: bool

    def attribute(self, pattern: str):
        found = re.search(pattern, self.attributes)
        return found.group(1) if found else None


def num_bytes(shape: str) -> int:
    total = 0
    for kind, dims in re.findall(r"\b([a-z]+\d*)\[([\d,]*)\]", shape):
        count = 1
        for d in filter(None, dims.split(",")):
            count *= int(d)
        total += SIZES.get(kind, 4) * count
    return total


def closing(text: str, start: int) -> int:
    depth = 0
    for i in range(start, len(text)):
        depth += {"(": 1, ")": -1}.get(text[i], 0)
        if not depth:
            return i
    raise ValueError(text[:200])


def parse_hlo(text: str):
    computations, current = {}, None
    for line in text.splitlines():
        head = re.match(r"(?:ENTRY )?%([\w.\-]+) \(.*\{$", line)
        if head:
            current = computations.setdefault(head.group(1), {})
            continue
        match = re.match(r"  (ROOT )?%([\w.\-]+) = ", line)
        if not match or current is None:
            continue
        rest = re.sub(r"/\*.*?\*/", "", line[match.end() :])
        end = closing(rest, 0) + 1 if rest[0] == "(" else rest.index(" ")
        shape, rest = rest[:end], rest[end:].lstrip()
        opened = rest.index("(")
        closed = closing(rest, opened)
        operands = re.findall(r"%([\w.\-]+(?:#\d+)?)", rest[opened:closed])
        for operand in operands:  # %name#2 is element 2 of a tuple
            name, _, place = operand.partition("#")
            if place and operand not in current and name in current:
                element = re.findall(r"[a-z]+\d*\[[\d,]*\]", current[name].shape)[int(place)]
                current[operand] = Op(operand, element, "get-tuple-element", [name], "", False)
        attributes = rest[closed + 1 :]
        if rest[:opened] == "parameter":
            attributes = rest[opened + 1 : closed] + attributes
        current[match.group(2)] = Op(match.group(2), shape, rest[:opened], operands, attributes, bool(match.group(1)))
    return computations


def fusion_bytes(computation: dict) -> int:
    """Bytes that a fusion reads and writes: of gathered, sliced or scattered arrays only what is touched."""
    users = collections.defaultdict(list)
    for op in computation.values():
        for place, operand in enumerate(op.operands):
            users[operand].append((op, place))

    def read(name: str) -> int:
        total, whole = 0, num_bytes(computation[name].shape)
        for op, place in users[name]:
            if op.opcode == "bitcast":
                total += read(op.name)
            elif op.opcode in ("gather", "dynamic-slice", "slice") and place == 0:
                total += num_bytes(op.shape)
            elif op.opcode in ("scatter", "dynamic-update-slice") and place == 0:
                total += num_bytes(computation[op.operands[2 if op.opcode == "scatter" else 1]].shape) * (
                    op.opcode == "scatter"
                )
            else:
                return whole
        return min(total, whole) if not any(op.opcode == "gather" for op, _ in users[name]) else total

    def written(op: Op) -> int:
        if op.opcode == "tuple":
            return sum(written(computation[o]) for o in op.operands)
        if op.opcode == "bitcast":
            return written(computation[op.operands[0]])
        if op.opcode == "scatter":
            return num_bytes(computation[op.operands[2]].shape)
        if op.opcode == "dynamic-update-slice":
            return num_bytes(computation[op.operands[1]].shape)
        return num_bytes(op.shape)

    parameters = [op.name for op in computation.values() if op.opcode == "parameter"]
    return sum(map(read, parameters)) + sum(written(op) for op in computation.values() if op.root)


def op_bytes(computations: dict, computation: dict, op: Op) -> int:
    if op.opcode == "fusion":
        return fusion_bytes(computations[op.attribute(r"calls=%([\w.\-]+)")])
    inputs = sum(num_bytes(computation[o].shape) for o in op.operands if o in computation)
    if op.opcode == "custom-call":  # without the workspace
        return inputs + num_bytes(re.sub(r"s8\[\d+\]", "", op.shape))
    if op.opcode in ("dynamic-slice", "slice", "gather"):
        inputs = num_bytes(op.shape)
    return inputs + num_bytes(op.shape)


def atomics(computations: dict, op: Op | None) -> int:
    """Numbers added by a scatter, each with an atomic of its own."""
    if op is None or op.opcode != "fusion":
        return 0
    inside = computations[op.attribute(r"calls=%([\w.\-]+)")]
    return sum(num_bytes(inside[o.operands[2]].shape) // 4 for o in inside.values() if o.opcode == "scatter")


def branches(computations: dict, op: Op | None) -> int:
    """How many ways a kernel can go, of which a thread goes one: pieces of what it concatenates."""
    if op is None or op.opcode != "fusion":
        return 1
    inside = computations[op.attribute(r"calls=%([\w.\-]+)")]
    return max((len(o.operands) for o in inside.values() if o.opcode == "concatenate"), default=1)
