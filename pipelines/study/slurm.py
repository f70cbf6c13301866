"""Settings for workers on Slurm: a small TOML file, `pipelines/plans/slurm.toml` to begin from.

Each text becomes one line of a job script, so line breaks are refused.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from liex_lab.errors import StudyError
from liex_lab.plan import plans_folder
from liex_lab.runtime.text_files import read_toml

# one line of a job script each: nothing in the file may begin another line
Line = Annotated[str, Field(pattern=r"^[^\r\n\x00]*$", max_length=1000)]
Word = Annotated[str, Field(pattern=r"^[A-Za-z0-9_.:/@+-]+$", max_length=200)]


class SlurmTable(BaseModel):
    """Every setting of the file; the comments in slurm.toml say what each is for.

    Attributes:
        jobs: jobs at most; each measures one session after the other.
        cores_per_job: cores of a job.
        memory: memory of a job, as Slurm writes it.
        walltime: time after which Slurm ends a job, HH:MM:SS.
        partition: the partition, if one is to be named.
        account: the account, if one is to be named.
        interface: network interface on which jobs and the command see each other.
        shared_folder: folder that all nodes see; keys made for this run go there.
        local_folder: folder on the nodes for temporary files.
        log_folder: folder for the jobs' own logs.
        prologue: lines of the job script before the worker starts.
        directives: further #SBATCH lines.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    jobs: int = Field(8, ge=1, le=10_000)
    cores_per_job: int = Field(2, ge=1, le=256)
    memory: Word = "4GB"
    walltime: Word = "12:00:00"
    partition: Word | None = None
    account: Word | None = None
    interface: Word | None = None
    shared_folder: Line = "~/.liex_lab"
    local_folder: Line | None = None
    log_folder: Line | None = None
    prologue: list[Line] = []
    directives: list[Line] = []

    @staticmethod
    def load(path: str | Path) -> SlurmTable:
        """The settings in a TOML file.

        Args:
            path: the file; `slurm` is the bundled one.

        Raises:
            StudyError: there is no such file, or something in it cannot be used.
        """
        file = plans_folder() / "slurm.toml" if str(path) == "slurm" else Path(path)
        if not file.is_file():
            raise StudyError(
                f"there is no file {file}; copy {plans_folder() / 'slurm.toml'} and change the copy"
            )
        try:
            return SlurmTable.model_validate(read_toml(file))
        except ValidationError as error:  # which is a ValueError, too
            first = error.errors(include_url=False)[0]
            where = ".".join(str(part) for part in first["loc"])
            raise StudyError(
                f"{file}: {where}: {first['msg']}; compare it with the bundled slurm.toml"
            ) from None
        except ValueError as error:
            raise StudyError(f"{file} should be a TOML file, but: {error}; correct it") from None
