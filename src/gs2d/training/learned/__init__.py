"""Quantities of images and cameras that are learned with the splats: exposure, poses, intrinsics and more."""
