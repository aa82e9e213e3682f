import sys
from pathlib import Path

# The unseen robot is shared by several test files.
sys.path.insert(0, str(Path(__file__).parent))
