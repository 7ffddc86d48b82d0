"""The simulator's tests run without tests/conftest.py, which imports PyTorch, where there is no PyTorch."""

from tests.interrupts import hear_ctrl_c

hear_ctrl_c()
