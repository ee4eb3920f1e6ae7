"""Robot policies learned in the benchmark: PPO, SAC, TAC and behaviour cloning (paper, sec. VI-D). Needs the extra
`agents`."""
