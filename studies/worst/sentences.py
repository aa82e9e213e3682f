"""The findings of a search in sentences."""

from __future__ import annotations

from typing import Any


def sentences(results: dict[str, Any]) -> list[str]:
    """Return the findings in sentences."""
    label, sample, failures = results["policy"]["label"], results["sample"], results["failures"]
    percent = f"{100 * results['rules']['confidence']:g} %"
    found = [
        f"{label} fell in {sample['falls']} of {sample['cases']} cases drawn uniformly from the ranges: the probability of a fall is "
        f"at most {100 * sample['bound']:.1f} % ({percent} confidence, Clopper and Pearson; equal weights)."
    ]
    found += [
        f"Of these falls, {count} are falls in {engine} too."
        for engine, count in sample["again"].items()
        if sample["falls"]
    ]
    plays = results["search"]["plays"]
    if not failures and results["search"]["falls"]:
        more = "go on with --resume and more --minutes"
        return [
            *found,
            f"The budget ended before it was known what the falls need that were found in {plays} plays; {more}.",
        ]
    if not failures:
        return [*found, f"The search found no failure in {plays} plays."]
    if any(not failure["factors"] for failure in failures):
        found.append("It falls where nothing is unusual.")
    gallery = [failure for failure in failures if failure["rank"] is not None]
    shown = "1 that is confirmed" if len(gallery) == 1 else f"{len(gallery)} that are confirmed and differ in cause"
    found.append(f"The search found falls with {_sets(len(failures))}, among them {shown}.")
    alone = [failure for failure in failures if failure["only_here"]]
    if results["others"]:
        engines = ", ".join(other["engine"] for other in results["others"])
        found.append(
            f"With the seeds that were played, {len(alone)} of {len(failures)} fall in {results['engine']} alone, not in {engines}."
        )
    else:
        found.append("No other engine has played them again.")
    return found


def _sets(count: int) -> str:
    return "1 set of factors" if count == 1 else f"{count} sets of factors"
