"""Stretch of a yarn segment."""

from cases import Case
from checks import InternalChecks
from reference import Tensor, clamped


class TestStretch(InternalChecks):
    term = "stretch"

    def expected_matrix(self, case: Case) -> Tensor:
        """The exact positive semi-definite part of every segment's second derivative, taut or slack."""
        elements = self.oracle(case).stretch
        return elements.matrix(clamped(elements.hessians(case.q)), len(case.q))
