"""Parts of the contact probe: light source with shutter and cover, suction pump with gauge."""
