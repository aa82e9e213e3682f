"""Say in words how two contracts differ, and a contract from a network's width."""

from __future__ import annotations

from .contract import PolicyContract


def other_width(contract: PolicyContract, width: int) -> str:
    """Return a contract's observation width as part of a sentence on a network with another width, and what would fit."""
    frames, rest = divmod(width, contract.frame_width)
    fits = f"; {frames} frames are {width}: history = {{ length = {frames} }}" if frames and not rest else ""
    return (
        f"but its contract's observation has {contract.observation_width} "
        f"({', '.join(f'{t.name} {w}' for t, w in zip(contract.observation, contract.term_widths, strict=True))}){fits}"
    )


def difference(a: PolicyContract, b: PolicyContract) -> str:
    """Return two contracts' differences but for provenance, lines ``field: value in a -> value in b``; empty where they are equal."""
    left, right = _flat(a), _flat(b)
    lines = [
        f"{n}: {left.get(n, 'absent')} -> {right.get(n, 'absent')}" for n in left | right if left.get(n) != right.get(n)
    ]
    return "\n".join(lines)


def _flat(contract: PolicyContract) -> dict[str, str]:
    rows: dict[str, str] = {}
    for name, value in contract.to_dict().items():
        if name == "observation":
            rows["observation"] = ", ".join(t["name"] for t in value)
            for term in value:
                rows.update({f"observation.{term['name']}.{k}": repr(v) for k, v in term.items() if k != "name"})
        elif name == "history":
            rows.update({f"history.{key}": repr(entry) for key, entry in value.items()})
        elif name != "provenance":
            rows[name] = repr(value)
    return rows
