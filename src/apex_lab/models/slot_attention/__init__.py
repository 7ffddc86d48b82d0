"""Slot Attention (Locatello et al. 2020), the object-discovery auto-encoder."""

from apex_lab.models.slot_attention.model import SlotAttention

__all__ = ["SlotAttention"]
