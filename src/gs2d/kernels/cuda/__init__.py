"""The CUDA kernels: sources (``*.cu``, ``*.h``) and how they are compiled. Nothing here is imported without need."""
