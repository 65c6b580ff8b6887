"""Seams: springs between pairs of nodes, anywhere in the cloth."""

from cases import Case
from checks import InternalChecks
from reference import Tensor


class TestSeams(InternalChecks):
    term = "seams"

    def expected_matrix(self, case: Case) -> Tensor:
        """The exact second derivative."""
        elements = self.oracle(case).seams
        return elements.matrix(elements.hessians(case.q), len(case.q))
