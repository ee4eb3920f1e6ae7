"""Pictures and films, drawn offscreen with MuJoCo and OpenCV: what films of crowds and of robots have in common.

A pedestrian is drawn as a figure inside its true cylinder (radius 0.35 m if nothing else is said, height 1.7 m),
coloured by its LCF. Pictures are RGB, (height, width, 3) uint8. Drawing needs OpenGL: `gl.gl_problem()` says what is
missing.
"""
