"""Images of boards from their artwork: reflectance map, camera pose, motion blur, and the noise of a sensor."""
