"""Export of a solver as standalone C or WebAssembly source code."""
