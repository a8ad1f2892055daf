"""Several meshes of one object: registration, markers, turntable, fusion."""
