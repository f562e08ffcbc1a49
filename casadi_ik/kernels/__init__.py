"""Kernels: a CasADi Function becomes a fast callable."""

from casadi_ik.kernels.compiler import NoCompilerWarning
from casadi_ik.kernels.folders import CacheWarning, cache_directory
from casadi_ik.kernels.function_graph import FunctionGraph
from casadi_ik.kernels.function_kernel import FunctionKernel
from casadi_ik.kernels.layout import Field, Layout
from casadi_ik.kernels.lookup import LookupKernel
from casadi_ik.kernels.loop import LoopKernel
from casadi_ik.kernels.loop_result import FAILED, NON_FINITE, REPEATED, LoopResult
from casadi_ik.kernels.step_graph import RUNNING, StepGraph

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
