"""Reference world: voxel skin that no reconstruction equation describes."""
