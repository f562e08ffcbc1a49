"""Tests of the kernels: compiled code equals the virtual machine."""
