"""Systems of bodies or of generalized coordinates: states, mass, forces, motion."""
