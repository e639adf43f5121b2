"""Visual servoing: frames, delay, observer, controllers and the loop that steers a head by its camera."""
