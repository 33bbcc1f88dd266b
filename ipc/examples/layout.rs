//! Prints every message's layout, for other languages.

use roomcast_ipc::raw::{
    DecisionV1, Field, ForecastV1, IncludedV1, ItemScoreV1, ItemScoresHeaderV1, Layout, NarrationV1, PersonForecastV1,
    PersonForecastsV1, PersonScoresV1, PersonV1, RobotReportV1, RoomScoresV1, RoomV1, StatusRequestV1,
    StatusResponseV1,
};

fn print<T: Layout>() {
    println!("{} ({} bytes)", T::TYPE_NAME, size_of::<T>());
    for Field { offset, name, kind, size } in T::FIELDS {
        println!("  {offset:>5}  {size:>5}  {name}: {kind}");
    }
}

fn main() {
    print::<NarrationV1>();
    print::<IncludedV1>();
    print::<RoomV1>();
    print::<RoomScoresV1>();
    print::<PersonV1>();
    print::<PersonScoresV1>();
    print::<ItemScoresHeaderV1>();
    print::<ItemScoreV1>();
    print::<ForecastV1>();
    print::<PersonForecastV1>();
    print::<PersonForecastsV1>();
    print::<DecisionV1>();
    print::<RobotReportV1>();
    print::<StatusRequestV1>();
    print::<StatusResponseV1>();
}
