"""Bounded biharmonic weights on a voxel lattice around any mesh (S2)."""
