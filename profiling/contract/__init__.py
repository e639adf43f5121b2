"""Contract between devices: stated limits of the results of public operations, and a corpus that checks them.

One module for each benchmark module, of the same name. ``LIMITS`` states for the public operations of the module the
largest difference of each output from float64. The limits follow from the error models, not from results. ``cases()``
yields seeded inputs, realistic and extreme, with float64 results. `agreement` runs the cases on devices.
"""
