"""Compilation of CasADi Functions to C kernels, their cache, and the loop that runs them."""

from casadi_ik.compile.cache import CacheWarning, cache_directory
from casadi_ik.compile.compiler import NoCompilerWarning
from casadi_ik.compile.function_kernel import FunctionKernel
from casadi_ik.compile.graphs import RUNNING, FunctionGraph, StepGraph
from casadi_ik.compile.layout import Field, Layout
from casadi_ik.compile.lookup import LookupKernel
from casadi_ik.compile.loop import FAILED, NON_FINITE, REPEATED, LoopKernel, LoopResult

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
