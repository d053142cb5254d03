"""The renderer: meshes, materials, integrators and the backend they run on."""
