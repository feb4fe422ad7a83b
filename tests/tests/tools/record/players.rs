//! What players find in recordings.

use std::collections::BTreeMap;
use std::path::Path;

use plantd_client::v1;
use plantd_proto::foxglove::{FrameTransforms, SceneUpdate};
use prost::Message;

use super::setup;

/// A message with its log time and its publish time, ns.
type Timed<T> = (u64, u64, T);

/// The messages of a topic.
fn messages<T: Message + Default>(file: &Path, topic: &str) -> Vec<Timed<T>> {
    let bytes = std::fs::read(file).unwrap();
    let all = mcap::MessageStream::new(&bytes).unwrap().map(Result::unwrap);
    let of_topic = all.filter(|message| message.channel.topic == topic);
    let timed = of_topic.map(|message| {
        (message.log_time, message.publish_time, T::decode(&*message.data).unwrap())
    });
    timed.collect()
}

fn shapes(entity: &plantd_proto::foxglove::SceneEntity) -> usize {
    entity.cubes.len() + entity.spheres.len() + entity.cylinders.len()
}

#[tokio::test]
async fn frames_are_where_the_kinematics_say() {
    let setup = setup(&[]).await;
    for model in ["marionette", "cart-pole", "four-bar"] {
        let plant = setup.plant(model).await;
        setup.record(&plant.id, model).await;
        let states = setup.step(&plant.id, 30, 3).await;
        setup.client.stop_recording(model).await.unwrap();
        let file = setup.file(model);
        let record = messages::<v1::PlantRecord>(&file, "/plant").remove(0).2;
        let drawing = record.drawing.expect("a drawing");
        let names: Vec<_> = drawing.frames.iter().map(|frame| frame.name.clone()).collect();
        let all = messages::<FrameTransforms>(&file, "/tf");
        // The state at the beginning comes first.
        assert_eq!(all.len(), 31, "{model}");
        for ((log_ns, publish_ns, transforms), state) in all[1..].iter().zip(&states) {
            let ns = (1e9 * state.time_s).round() as u64;
            assert_eq!((*log_ns, *publish_ns), (ns, ns), "{model}");
            let request = v1::KinematicsRequest {
                state: Some(v1::MechanicalState {
                    model: model.to_owned(),
                    q: state.q.clone(),
                    v: state.velocity.clone(),
                    ..Default::default()
                }),
                frames: names.clone(),
                ..Default::default()
            };
            let expected = setup.client.kinematics(request).await.unwrap().frames;
            assert_eq!(transforms.transforms.len(), expected.len());
            for (transform, frame) in transforms.transforms.iter().zip(expected) {
                assert_eq!(
                    (&*transform.parent_frame_id, &transform.child_frame_id),
                    ("world", &frame.frame)
                );
                let at = transform.translation.unwrap();
                let axes = transform.rotation.unwrap();
                let sign = if axes.w * frame.orientation[0] < 0.0 { -1.0 } else { 1.0 };
                let pose =
                    [at.x, at.y, at.z, sign * axes.w, sign * axes.x, sign * axes.y, sign * axes.z];
                let numbers = frame.position.iter().chain(&frame.orientation);
                for (ours, theirs) in pose.iter().zip(numbers) {
                    assert!((ours - theirs).abs() < 1e-9, "{model} {}: {pose:?}", frame.frame);
                }
                let stamp = transform.timestamp.unwrap();
                assert_eq!(stamp.seconds as u64 * 1_000_000_000 + stamp.nanos as u64, ns);
            }
        }
        // Each shape is in a frame that moves.
        let scenes = messages::<SceneUpdate>(&file, "/scene");
        assert_eq!(scenes.len(), 1, "{model}");
        let entities: BTreeMap<_, _> =
            scenes[0].2.entities.iter().map(|e| (e.frame_id.clone(), shapes(e))).collect();
        assert_eq!(
            entities.keys().cloned().collect::<std::collections::BTreeSet<_>>(),
            names.into_iter().collect()
        );
        assert!(entities.values().all(|count| *count > 0), "{model}: {entities:?}");
        // As many points as the drawing has.
        let lines = messages::<SceneUpdate>(&file, "/lines");
        assert_eq!(lines.len(), all.len(), "{model}");
        let entity = &lines[5].2.entities[0];
        let points = entity.lines.iter().map(|line| line.points.len() as u32).sum::<u32>();
        assert_eq!(points, drawing.lines.iter().map(|line| 2 * (line.points - 1)).sum::<u32>());
        assert_eq!(entity.arrows.len(), drawing.arrows.len());
    }
}

#[tokio::test]
async fn players_get_a_hundred_pictures_a_second_and_go_on_after_a_reset() {
    let setup = setup(&[]).await;
    let request = v1::CreatePlantRequest {
        model: "pendulum".to_owned(),
        settings: Some(v1::PlantSettings { time_step_s: 0.001, ..Default::default() }),
        ..Default::default()
    };
    let id = setup.client.create_plant(request).await.unwrap().id;
    setup.record(&id, "fast").await;
    setup.step(&id, 500, 1).await;
    setup.client.reset(&id).await.unwrap();
    setup.step(&id, 100, 2).await;
    let longer =
        v1::Parameter { path: "frames[rod].body.center_of_mass[1]".to_owned(), value: -2.0 };
    let request =
        v1::SetParametersRequest { id: id.clone(), parameters: vec![longer], ..Default::default() };
    setup.client.set_parameters(request).await.unwrap();
    setup.step(&id, 100, 3).await;
    setup.client.stop_recording("fast").await.unwrap();
    let file = setup.file("fast");
    let frames = messages::<FrameTransforms>(&file, "/tf");
    let ms = 1_000_000;
    let times: Vec<_> = frames.iter().map(|(log, publish, _)| (log / ms, publish / ms)).collect();
    // At most one in each ten milliseconds of the plant, and one when its numbers change; fewer where the recorder
    // is behind. The time of the log goes on where that of the plant begins anew.
    assert_eq!(times[0], (0, 0));
    assert!(times.windows(2).all(|pair| pair[0].0 < pair[1].0), "{times:?}");
    let (first, second): (Vec<_>, Vec<_>) = times.iter().partition(|(log, time)| log == time);
    assert!((2..=51).contains(&first.len()) && (2..=23).contains(&second.len()), "{times:?}");
    assert!(second.iter().all(|(log, time)| *log == time + 500), "{times:?}");
    // The mass hangs elsewhere, and so does what shows it.
    let scenes = messages::<SceneUpdate>(&file, "/scene");
    assert_eq!(scenes.len(), 2);
    let height = |scene: &SceneUpdate| {
        let entity = &scene.entities[0];
        let poses =
            entity.spheres.iter().map(|s| s.pose).chain(entity.cubes.iter().map(|c| c.pose));
        poses.map(|pose| pose.unwrap().position.unwrap().y).fold(0.0, f64::min)
    };
    assert!(
        (height(&scenes[0].2) + 1.0).abs() < 1e-12 && (height(&scenes[1].2) + 2.0).abs() < 1e-12
    );
    // Steps have the wall clock with them.
    let steps = messages::<v1::StepRecord>(&file, "/step");
    assert_eq!(steps.len(), 700);
    assert!(
        steps.windows(2).all(|pair| pair[0].2.utc_ns <= pair[1].2.utc_ns && pair[0].0 <= pair[1].0)
    );
    assert!(steps[0].2.utc_ns > 1_600_000_000_000_000_000);
}
