//! `mmer.parquet`: the table for programs. One row group, uncompressed, every column optional.

use std::io::Write;
use std::sync::Arc;

use parquet::basic::{LogicalType, Repetition, Type as Physical};
use parquet::data_type::{BoolType, ByteArray, ByteArrayType, DataType, DoubleType, Int64Type};
use parquet::errors::Result;
use parquet::file::writer::{SerializedFileWriter, SerializedRowGroupWriter};
use parquet::schema::types::Type;

use super::tables::Row;

/// A column: one value a row.
enum Column {
    Text(Vec<Option<ByteArray>>),
    Count(Vec<Option<i64>>),
    Number(Vec<Option<f64>>),
    Truth(Vec<Option<bool>>),
}

/// Writes `rows` to `out`.
///
/// # Errors
/// What keeps `out` from being written.
pub fn write<W: Write + Send>(out: W, rows: &[Row]) -> anyhow::Result<()> {
    let columns = columns(rows);
    let fields = columns.iter().map(|(name, column)| field(name, column)).collect::<Result<Vec<_>>>()?;
    let schema = Arc::new(Type::group_type_builder("mmer").with_fields(fields).build()?);
    let mut file = SerializedFileWriter::new(out, schema, Arc::default())?;
    let mut group = file.next_row_group()?;
    for (_, column) in &columns {
        match column {
            Column::Text(values) => write_column::<ByteArrayType, W>(&mut group, values)?,
            Column::Count(values) => write_column::<Int64Type, W>(&mut group, values)?,
            Column::Number(values) => write_column::<DoubleType, W>(&mut group, values)?,
            Column::Truth(values) => write_column::<BoolType, W>(&mut group, values)?,
        }
    }
    group.close()?;
    file.close()?;
    Ok(())
}

fn write_column<D: DataType, W: Write + Send>(
    group: &mut SerializedRowGroupWriter<'_, W>,
    values: &[Option<D::T>],
) -> anyhow::Result<()> {
    let Some(mut column) = group.next_column()? else { anyhow::bail!("fewer columns in the schema than in the table") };
    let present: Vec<D::T> = values.iter().flatten().cloned().collect();
    let levels: Vec<i16> = values.iter().map(|value| i16::from(value.is_some())).collect();
    column.typed::<D>().write_batch(&present, Some(&levels), None)?;
    Ok(column.close()?)
}

fn field(name: &str, column: &Column) -> Result<Arc<Type>> {
    let (physical, logical) = match column {
        Column::Text(_) => (Physical::BYTE_ARRAY, Some(LogicalType::String)),
        Column::Count(_) => (Physical::INT64, None),
        Column::Number(_) => (Physical::DOUBLE, None),
        Column::Truth(_) => (Physical::BOOLEAN, None),
    };
    let builder = Type::primitive_type_builder(name, physical).with_repetition(Repetition::OPTIONAL);
    Ok(Arc::new(builder.with_logical_type(logical).build()?))
}

/// The table by columns.
fn columns(rows: &[Row]) -> Vec<(&'static str, Column)> {
    let text = |of: fn(&Row) -> &String| Column::Text(rows.iter().map(|r| Some(of(r).as_str().into())).collect());
    let count = |of: fn(&Row) -> u64| Column::Count(rows.iter().map(|r| Some(of(r) as i64)).collect());
    let number = |of: fn(&Row) -> Option<f64>| Column::Number(rows.iter().map(of).collect());
    vec![
        ("env", text(|r| &r.env)),
        ("group", text(|r| &r.group)),
        ("difficulty", text(|r| &r.difficulty)),
        ("preset", text(|r| &r.preset)),
        ("memory", text(|r| &r.memory)),
        ("paper_memory", text(|r| &r.paper_memory)),
        ("seeds", count(|r| r.seeds)),
        ("budget_min", count(|r| r.budget_min)),
        ("budget_max", count(|r| r.budget_max)),
        ("steps_min", count(|r| r.steps_min)),
        ("steps_max", count(|r| r.steps_max)),
        ("stopped_early", count(|r| r.stopped_early)),
        ("mmer_mean", number(|r| r.mmer_mean)),
        ("mmer_std", number(|r| r.mmer_std)),
        ("mmer_65k_seeds", count(|r| r.mmer_65k_seeds)),
        ("mmer_65k_mean", number(|r| r.mmer_65k_mean)),
        ("mmer_65k_std", number(|r| r.mmer_65k_std)),
        ("paper_mean", number(|r| r.paper_mean)),
        ("paper_std", number(|r| r.paper_std)),
        ("paper_steps", Column::Count(rows.iter().map(|r| r.paper_steps.map(|steps| steps as i64)).collect())),
        ("difference", number(|r| r.difference)),
        ("two_standard_errors", number(|r| r.two_standard_errors)),
        ("within_two_standard_errors", Column::Truth(rows.iter().map(|r| r.within_two_standard_errors).collect())),
        ("notes", text(|r| &r.notes)),
    ]
}

#[cfg(test)]
mod tests {
    use std::fs::{self, File};

    use parquet::file::reader::{FileReader as _, SerializedFileReader};
    use parquet::record::Field;

    use super::super::samples::cells_of;
    use super::super::tables::mmer_csv;
    use super::*;

    #[test]
    fn reads_back() {
        let cells = cells_of(&[("RepeatFirstEasy", "gru", &[1.0, 0.5]), ("VelocityOnlyCartPoleEasy", "mlp", &[0.5])]);
        let rows: Vec<Row> = cells.iter().map(Row::from).collect();
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("mmer.parquet");
        write(File::create(&path).unwrap(), &rows).unwrap();
        assert_eq!(fs::read(&path).unwrap()[..4], *b"PAR1");

        let reader = SerializedFileReader::new(File::open(&path).unwrap()).unwrap();
        let found: Vec<Vec<(String, Field)>> = reader
            .get_row_iter(None)
            .unwrap()
            .map(|row| row.unwrap().get_column_iter().map(|(name, field)| (name.clone(), field.clone())).collect())
            .collect();
        // The same columns as the CSV, and the same values.
        let names: Vec<&str> = found[0].iter().map(|(name, _)| name.as_str()).collect();
        assert_eq!(names.join(","), mmer_csv(&cells).unwrap().lines().next().unwrap());
        let value = |row: usize, name: &str| &found[row].iter().find(|(known, _)| known == name).unwrap().1;
        assert_eq!(*value(0, "env"), Field::Str("RepeatFirstEasy".into()));
        assert_eq!(*value(0, "steps_max"), Field::Long(70_000));
        assert_eq!(*value(0, "mmer_mean"), Field::Double(0.75));
        assert_eq!(*value(0, "difference"), Field::Double(rows[0].difference.unwrap()));
        assert_eq!(*value(0, "within_two_standard_errors"), Field::Bool(true));
        assert_eq!(*value(1, "paper_mean"), Field::Null);
        assert_eq!(*value(1, "mmer_std"), Field::Null);
        assert_eq!(found.len(), 2);
    }
}
