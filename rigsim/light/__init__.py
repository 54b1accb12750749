"""Light on skin: BRDF, shadows, interreflection and lateral scattering."""
