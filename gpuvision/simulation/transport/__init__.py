"""Light transport from the sheet of light over the scene to the sensor."""
