"""OP3 (Veerapaneni et al. 2019): iterative refinement of slots, and an interaction network between frames."""

from apex_lab.models.op3.model import Op3

__all__ = ["Op3"]
