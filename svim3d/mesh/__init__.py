"""Triangle and tetrahedral meshes: extraction, regularisers, cleanup, atlases, texels."""
