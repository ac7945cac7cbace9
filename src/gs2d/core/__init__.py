"""What every room uses: cameras, splats, meshes, images, transforms, checked shapes, atomic files."""
