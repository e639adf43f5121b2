"""Float64 references of the operations, written from the equations in NumPy and SciPy.

They share no code with the operations and import nothing from the rest of `gpuvision`: constants of physics and status
flags are written out in each module. They are slow and as plain as possible.

The tests compare every kernel with them. Use them to check a device of your own. The modules `line_irradiance`,
`occluded_irradiance` and `patches` need mpmath, which the extra ``reference`` installs.
"""
