"""A Function in CasADi's virtual machine on fixed arrays: no allocation per call."""

from __future__ import annotations

import ctypes
import logging
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

logger = logging.getLogger(__name__)

_BYTE: Any = ctypes.c_char


class BufferedFunction:
    """One function with its own input and output arrays; not to be shared by threads.

    Attributes:
        inputs: Flat arrays of the inputs' memory; write into them.
        outputs: Flat arrays of the outputs' memory; a call overwrites them.
    """

    def __init__(self, function: ca.Function) -> None:
        """Make the arrays.

        Args:
            function: Dense and row-major (`codegen.row_major`).
        """
        self.inputs = [np.zeros(function.numel_in(i)) for i in range(function.n_in())]
        self.outputs = [np.zeros(function.numel_out(i)) for i in range(function.n_out())]
        # The stubs of CasADi describe the C++ signatures of a buffer, not Python's.
        buffer: Any
        buffer, self._evaluate = function.buffer()
        for i, array in enumerate(self.inputs):
            buffer.set_arg(i, array.data)
        for i, array in enumerate(self.outputs):
            buffer.set_res(i, array.data)
        self._buffer = buffer
        self._name = function.name()

    def __call__(self) -> bool:
        """Evaluate; False if the function itself reports a failure, as generated code would."""
        try:
            self._evaluate()
        except SystemError as error:
            # A buffer reports Ctrl-C inside an evaluation as this.
            if isinstance(error.__cause__, KeyboardInterrupt):
                raise KeyboardInterrupt from error
            raise
        except RuntimeError as error:
            # ... or, if it came while Ipopt was at work, as that.
            if str(error) == "KeyboardInterrupt":
                raise KeyboardInterrupt from error
            logger.warning("function %r failed: %s", self._name, error)
            return False
        return self._buffer.ret() == 0


def memory(array: NDArray[Any]) -> int:
    """The address of an array's first element."""
    if array.flags.writeable and array.flags.c_contiguous and array.size:
        # A third of the time of the way below, which knows every array.
        return ctypes.addressof(_BYTE.from_buffer(array))
    return array.ctypes.data


def doubles(values: Any) -> NDArray[np.float64]:
    """The values as an aligned C-contiguous array of doubles, copied only if they are not."""
    array = np.asarray(values, dtype=np.float64, order="C")
    return array if array.flags.aligned else array.copy()
