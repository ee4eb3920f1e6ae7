"""The engines, which compute physics, rays and pictures of many worlds: one file for each engine, all with the
interface `base.Engine`."""
