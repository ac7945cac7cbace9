"""Values without files: cameras, splats, meshes, images, transforms; shape checks, atomic files and memory limits."""
