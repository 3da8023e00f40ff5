"""A WSP unit that is an FMU: signal level (FMI 2 and FMI 3) or with a CAN port (FMI-LS-BUS)."""
