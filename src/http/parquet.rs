//! Tables as Parquet files: flat optional columns, one row group for each part.

use std::io::Write;
use std::sync::{Arc, Mutex};

use parquet::basic::{Compression, LogicalType, Repetition, TimeUnit, Type as Physical};
use parquet::data_type::{BoolType, ByteArray, ByteArrayType, DataType, DoubleType, Int64Type};
use parquet::errors::ParquetError;
use parquet::file::properties::WriterProperties;
use parquet::file::writer::{SerializedColumnWriter, SerializedFileWriter};
use parquet::schema::types::{Type, TypePtr};

use super::cell::{Cell, ColumnKind};

/// Writes a Parquet file part by part.
pub struct ParquetWriter {
    kinds: Vec<ColumnKind>,
    writer: SerializedFileWriter<Written>,
    written: Written,
}

/// Buffer that the Parquet library writes to and from which the parts are taken.
#[derive(Clone, Default)]
struct Written(Arc<Mutex<Vec<u8>>>);

impl Written {
    fn take(&self) -> Vec<u8> {
        std::mem::take(&mut self.0.lock().expect("no holder of this lock panics"))
    }
}

impl Write for Written {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0.lock().expect("no holder of this lock panics").extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

impl ParquetWriter {
    /// A file with these columns.
    ///
    /// # Errors
    /// [`ParquetError`] for invalid column names.
    pub fn new<N: AsRef<str>>(columns: &[(N, ColumnKind)]) -> Result<Self, ParquetError> {
        let fields: Vec<TypePtr> =
            columns.iter().map(|(name, kind)| field(name.as_ref(), *kind).map(Arc::new)).collect::<Result<_, _>>()?;
        let schema = Type::group_type_builder("modalwatch").with_fields(fields).build()?;
        let properties = WriterProperties::builder().set_compression(Compression::SNAPPY).build();
        let written = Written::default();
        let writer = SerializedFileWriter::new(written.clone(), Arc::new(schema), Arc::new(properties))?;
        Ok(Self { kinds: columns.iter().map(|(_, kind)| *kind).collect(), writer, written })
    }

    /// Writes a row group and returns the bytes written so far.
    ///
    /// # Errors
    /// [`ParquetError`] for a row that does not fit the columns.
    pub fn rows(&mut self, rows: &[Vec<Cell>]) -> Result<Vec<u8>, ParquetError> {
        if rows.is_empty() {
            return Ok(Vec::new());
        }
        let mut group = self.writer.next_row_group()?;
        for (index, kind) in self.kinds.iter().enumerate() {
            let cells: Vec<&Cell> = rows.iter().filter_map(|row| row.get(index)).collect();
            let column = group.next_column()?.filter(|_| cells.len() == rows.len());
            let column =
                column.ok_or_else(|| ParquetError::General("a row has another length than the header".to_owned()))?;
            write_column(column, *kind, &cells)?;
        }
        group.close()?;
        self.writer.flush()?;
        Ok(self.written.take())
    }

    /// Writes the footer and returns it.
    ///
    /// # Errors
    /// [`ParquetError`].
    pub fn end(self) -> Result<Vec<u8>, ParquetError> {
        self.writer.close()?;
        Ok(self.written.take())
    }
}

fn field(name: &str, kind: ColumnKind) -> Result<Type, ParquetError> {
    let (physical, logical) = match kind {
        ColumnKind::Text => (Physical::BYTE_ARRAY, Some(LogicalType::String)),
        ColumnKind::Number => (Physical::DOUBLE, None),
        ColumnKind::Count => (Physical::INT64, None),
        ColumnKind::Flag => (Physical::BOOLEAN, None),
        ColumnKind::Time => (Physical::INT64, Some(LogicalType::timestamp(true, TimeUnit::MICROS))),
    };
    let field = Type::primitive_type_builder(name, physical);
    field.with_repetition(Repetition::OPTIONAL).with_logical_type(logical).build()
}

fn write_column(column: SerializedColumnWriter<'_>, kind: ColumnKind, cells: &[&Cell]) -> Result<(), ParquetError> {
    match kind {
        ColumnKind::Text => write::<ByteArrayType>(column, cells, |cell| match cell {
            Cell::Text(text) => Some(ByteArray::from(text.as_str())),
            _ => None,
        }),
        ColumnKind::Number => write::<DoubleType>(column, cells, |cell| match cell {
            Cell::Number(number) => Some(*number),
            _ => None,
        }),
        ColumnKind::Count => write::<Int64Type>(column, cells, |cell| match cell {
            Cell::Count(count) => Some(*count),
            _ => None,
        }),
        ColumnKind::Flag => write::<BoolType>(column, cells, |cell| match cell {
            Cell::Flag(flag) => Some(*flag),
            _ => None,
        }),
        ColumnKind::Time => write::<Int64Type>(column, cells, |cell| match cell {
            Cell::Time(time) => Some(time.micros()),
            _ => None,
        }),
    }
}

/// Writes a column. `value` returns the value of a cell of this type; an empty cell becomes a null.
fn write<T: DataType>(
    mut column: SerializedColumnWriter<'_>,
    cells: &[&Cell],
    value: impl Fn(&Cell) -> Option<T::T>,
) -> Result<(), ParquetError> {
    let (mut values, mut levels) = (Vec::new(), Vec::with_capacity(cells.len()));
    for cell in cells {
        let value = value(cell);
        if value.is_none() && **cell != Cell::Empty {
            return Err(ParquetError::General(format!("{cell:?} has another type than its column")));
        }
        levels.push(i16::from(value.is_some()));
        values.extend(value);
    }
    column.typed::<T>().write_batch(&values, Some(&levels), None)?;
    column.close()
}
