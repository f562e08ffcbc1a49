"""Kernels: a CasADi Function becomes a fast callable."""

from casadi_ik.kernels.cache import CacheWarning, cache_directory
from casadi_ik.kernels.compiler import NoCompilerWarning
from casadi_ik.kernels.function_kernel import FunctionKernel
from casadi_ik.kernels.graphs import RUNNING, FunctionGraph, StepGraph
from casadi_ik.kernels.layout import Field, Layout
from casadi_ik.kernels.lookup import LookupKernel
from casadi_ik.kernels.loop import FAILED, NON_FINITE, REPEATED, LoopKernel, LoopResult

__all__ = [
    "FAILED",
    "NON_FINITE",
    "REPEATED",
    "RUNNING",
    "CacheWarning",
    "Field",
    "FunctionGraph",
    "FunctionKernel",
    "Layout",
    "LookupKernel",
    "LoopKernel",
    "LoopResult",
    "NoCompilerWarning",
    "StepGraph",
    "cache_directory",
]
