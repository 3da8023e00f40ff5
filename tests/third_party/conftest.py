"""The Modbus site of tests/firmware_sim, for other people's clients."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent / "firmware_sim"))
