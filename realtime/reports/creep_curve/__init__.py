"""The reports of measured creep curves: of `rollerrig tune` and of `rollerrig explain`."""
