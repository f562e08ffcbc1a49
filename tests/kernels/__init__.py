"""Tests of the kernels: what is compiled equals what is not."""
