"""Parquet files, read by pyarrow."""

import io

import numpy as np

from ..messages import refusal
from .formats import TableFormat
from .grid import Cells, Grid
from .workbook import missing_extra


def read_parquet(data: bytes, name: str, form: TableFormat) -> Grid:
    """The grid of a parquet file; raises `StudyError` where it cannot be read.

    The reader is the optional extra ``parquet``. Time stamps become texts in ISO 8601.
    """
    try:
        import pyarrow as pa
        import pyarrow.compute as pc
        import pyarrow.parquet as pq
    except ImportError as error:
        raise missing_extra(name, "a parquet file", "parquet") from error
    try:
        table = pq.read_table(io.BytesIO(data))
    except (pa.ArrowException, OSError) as error:
        raise refusal(
            name, "file", f"a damaged parquet file ({error})", "a table", "write it again"
        ) from error
    columns = []
    for column in table.columns:
        kind = column.type
        if pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_decimal(kind):
            values = column.cast(pa.float64(), safe=False).to_numpy()
            columns.append(Cells(values=np.asarray(values, float)))
        elif pa.types.is_timestamp(kind):
            utc = "Z" if kind.tz else ""
            stamps = np.datetime_as_string(column.cast(pa.timestamp("ns")).to_numpy(), unit="ns")
            columns.append(Cells([f"{one}{utc}" for one in stamps.tolist()]))
        else:
            texts = pc.cast(column, pa.string(), safe=False).to_pylist()
            columns.append(Cells(["" if one is None else one for one in texts]))
    names = tuple(" ".join(str(one).split()) for one in table.column_names)
    return Grid(name, "parquet", names, columns, range(1, table.num_rows + 1), form=form)
