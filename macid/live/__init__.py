"""Pages to watch and to drive in, in a browser: the world in 3D, its controls, and the server behind them.

Needs the extra `live`. Every page that is opened has a world of its own, in a thread of its own: two pages don't
disturb each other, and a page that is closed takes its world along.
"""
