"""Files that gs2d writes: PLY, run folders."""
