"""Turns observations into actions: the policy contract, the observation builder, networks and policy files.

Only the contract is imported here, so that reading one does not wait for torch.
"""

from .comparing import difference
from .contract import (
    ContractError,
    History,
    ObservationTerm,
    PolicyContract,
    check_robot,
    standard_contract,
)

__all__ = [
    "ContractError",
    "History",
    "ObservationTerm",
    "PolicyContract",
    "check_robot",
    "difference",
    "standard_contract",
]
