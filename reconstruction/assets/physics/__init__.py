"""Physical attributes of objects: material, mass, friction and restitution, with ranges."""
