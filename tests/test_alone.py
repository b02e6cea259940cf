"""Another distribution ``stcal`` in the same environment is refused."""

import shutil
import subprocess
import sys
from pathlib import Path

import stcal
from stcal.errors import fault


def test_a_package_by_itself_is_no_fault(tmp_path):
    (tmp_path / "stereo_target_calibration-0.1.0.dist-info").mkdir()
    assert fault(tmp_path / "stcal") == ""


def test_another_distribution_beside_it_is_refused_at_import(tmp_path):
    package = tmp_path / "stcal"
    package.mkdir()
    for name in ("__init__.py", "errors.py"):
        shutil.copy(Path(stcal.__file__).with_name(name), package)
    (tmp_path / "stcal-1.20.0.dist-info").mkdir()
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import stcal"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    last = ended.stderr.splitlines()[-1]
    assert last.startswith(f"ImportError: {package}: the distribution stcal 1.20.0")
    assert "pip uninstall stcal" in last
