"""The CUDA kernels: sources (``*.cu``, ``*.h``) and how they are compiled. Modules are imported only when needed."""
