use grasp_sim::{camera::Views,label::Recipe,objects::*,scene::SceneKind};
fn main(){ for kind in [SceneKind::Pile,SceneKind::Packed]{ let set=std::env::args().nth(1).map(|d|ObjectSet::load(std::path::Path::new(&d)).unwrap()).unwrap_or_else(||ObjectSet::procedural(Split::Train));
 let recipe=Recipe{kind,objects:set,points:120,views:Views::Anywhere(1..=6),noise:true,seed:1};
 let t=std::time::Instant::now(); let n=12; let mut pos=0; let mut tot=0;
 for i in 0..n { if let Some(s)=recipe.label(i){ pos+=s.trials.iter().filter(|t|t.success).count(); tot+=s.trials.len(); } }
 let e=t.elapsed().as_secs_f64(); println!("{kind:?} {} points, {} positive, {:.1} points/s, {:.3} s/scene", tot,pos, tot as f64/e, e/n as f64);
}}
