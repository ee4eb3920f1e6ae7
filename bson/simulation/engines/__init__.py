"""What computes physics, rays and pictures of many worlds: one file an engine, all of them as `base.Engine` says."""
