"""Pedestrian crowds on MuJoCo, each person's temper set by one number, the local coordination factor (LCF)."""
