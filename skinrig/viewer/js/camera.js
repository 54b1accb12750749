// The camera orbits a point in front of the face; lights are directions from that point.
Object.assign(V.defaults, {
  camera_yaw_deg: 0, camera_pitch_deg: 0, camera_distance_mm: 620, camera_fov_deg: 28,
  camera_target_mm: [0, -22, -30], light_azimuth_deg: 35, light_elevation_deg: 30,
  light_intensity: 3.2, ambient: 0.12,
});

V.RAD = Math.PI / 180;
V.direction = (azimuth, elevation) => [
  Math.sin(azimuth * V.RAD) * Math.cos(elevation * V.RAD), Math.sin(elevation * V.RAD),
  Math.cos(azimuth * V.RAD) * Math.cos(elevation * V.RAD),
];

V.cameraKey = p => [p.camera_yaw_deg, p.camera_pitch_deg, p.camera_distance_mm, p.camera_fov_deg,
  ...p.camera_target_mm].join();

// Matrices in column order as in GL; near and far planes enclose the head for depth precision.
V.camera = (p, [width, height], shift = [0, 0, 0]) => {
  const back = V.direction(p.camera_yaw_deg, p.camera_pitch_deg);
  const right = V.direction(p.camera_yaw_deg + 90, 0);
  const up = [
    back[1] * right[2] - back[2] * right[1], back[2] * right[0] - back[0] * right[2],
    back[0] * right[1] - back[1] * right[0],
  ];
  const eye = p.camera_target_mm.map((t, i) => t + p.camera_distance_mm * back[i]);
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const moved = eye.map((e, i) => e - shift[i]);
  const view = [
    right[0], up[0], back[0], 0, right[1], up[1], back[1], 0, right[2], up[2], back[2], 0,
    -dot(right, moved), -dot(up, moved), -dot(back, moved), 1,
  ];
  const near = Math.max(5, p.camera_distance_mm - 400);
  const far = p.camera_distance_mm + 1200;
  const focal = 1 / Math.tan(0.5 * p.camera_fov_deg * V.RAD);
  const aspect = width / height;
  const projection = [
    focal / aspect, 0, 0, 0, 0, focal, 0, 0, 0, 0, (far + near) / (near - far), -1,
    0, 0, 2 * far * near / (near - far), 0,
  ];
  return {view, projection, eye: moved, near, far, pixelsPerMmAt1: 0.5 * height * focal};
};
