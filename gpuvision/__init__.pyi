"""Public names of gpuvision. ``__init__.py`` reads this stub: it is the only list of them."""

from .camera.camera import (
    Camera as Camera,
)
from .camera.cmos_sensor import (
    CmosSensor as CmosSensor,
)
from .camera.correction_uncertainty import (
    CorrectionMap as CorrectionMap,
)
from .camera.correction_uncertainty import (
    correction_covariance as correction_covariance,
)
from .camera.correction_uncertainty import (
    correction_map as correction_map,
)
from .camera.correction_uncertainty import (
    correction_sigma as correction_sigma,
)
from .camera.detection_stage import (
    DetectionStage as DetectionStage,
)
from .camera.image_map import (
    PixelMap as PixelMap,
)
from .camera.lens import (
    Lens as Lens,
)
from .camera.lines.lens_fit import (
    LensFit as LensFit,
)
from .camera.lines.lens_fit import (
    LensFitLimits as LensFitLimits,
)
from .camera.lines.line_families import (
    grid_lines as grid_lines,
)
from .camera.lines.vanishing_points import (
    fit_lens as fit_lens,
)
from .camera.lines.vanishing_points import (
    straightness_px as straightness_px,
)
from .camera.patterns.blobs import (
    BlobLimits as BlobLimits,
)
from .camera.patterns.chessboard import (
    ChessboardLimits as ChessboardLimits,
)
from .camera.patterns.chessboard import (
    find_chessboard as find_chessboard,
)
from .camera.patterns.dots import (
    DotLimits as DotLimits,
)
from .camera.patterns.dots import (
    find_dots as find_dots,
)
from .camera.patterns.line_pattern import (
    LinePatternLimits as LinePatternLimits,
)
from .camera.patterns.line_pattern import (
    find_lines as find_lines,
)
from .camera.patterns.pattern import (
    PatternGrid as PatternGrid,
)
from .camera.polynomial import (
    PlanePolynomial as PlanePolynomial,
)
from .camera.scheimpflug import (
    TiltedSensor as TiltedSensor,
)
from .camera.sensor_fit import (
    SensorFit as SensorFit,
)
from .camera.sensor_fit import (
    fit_sensor as fit_sensor,
)
from .camera.undistort_image import (
    UndistortedImage as UndistortedImage,
)
from .camera.undistort_image import (
    UndistortImage as UndistortImage,
)
from .camera.undistort_points import (
    UndistortedPoints as UndistortedPoints,
)
from .camera.undistort_points import (
    UndistortPoints as UndistortPoints,
)
from .camera.views.camera_fit import (
    CameraFit as CameraFit,
)
from .camera.views.diagnosis import (
    CalibrationLimits as CalibrationLimits,
)
from .camera.views.known_lens import (
    fit_tilt as fit_tilt,
)
from .camera.views.planar_calibration import (
    fit_camera as fit_camera,
)
from .camera.views.pose_response import (
    fit_pose as fit_pose,
)
from .camera.views.pose_response import (
    pose_responses as pose_responses,
)
from .camera.views.target_views import (
    make_view as make_view,
)
from .camera.views.tsai import (
    fit_tsai as fit_tsai,
)
from .formats.cmos_sensor_file import (
    read_cmos_sensor as read_cmos_sensor,
)
from .formats.features_file import (
    read_features as read_features,
)
from .formats.field_file import (
    read_field as read_field,
)
from .host import (
    Device as Device,
)
from .host import (
    GpuVisionError as GpuVisionError,
)
from .host import (
    Pipeline as Pipeline,
)
from .host import (
    Step as Step,
)
from .host import (
    clear_cache as clear_cache,
)
from .host import (
    fastest_device as fastest_device,
)
from .host import (
    host_view as host_view,
)
from .host import (
    open_recording as open_recording,
)
from .inspection.deposits import (
    DepositSums as DepositSums,
)
from .inspection.deposits import (
    MeasureDeposits as MeasureDeposits,
)
from .matching.artwork.artwork import (
    Artwork as Artwork,
)
from .matching.artwork.artwork import (
    read_artwork as read_artwork,
)
from .matching.artwork.board_reflectance import (
    BoardReflectance as BoardReflectance,
)
from .matching.board.located_board import (
    LocatedBoard as LocatedBoard,
)
from .matching.features.blob import (
    Blobs as Blobs,
)
from .matching.features.blob import (
    FindBlobs as FindBlobs,
)
from .matching.features.exposure import (
    sensor_imaging as sensor_imaging,
)
from .matching.features.exposure import (
    smallest_exposure as smallest_exposure,
)
from .matching.features.feature_set import (
    FeatureSet as FeatureSet,
)
from .matching.features.feature_set import (
    choose_features as choose_features,
)
from .matching.features.imaging import (
    Imaging as Imaging,
)
from .matching.features.line_fit import (
    FitLines as FitLines,
)
from .matching.features.line_fit import (
    LineFits as LineFits,
)
from .matching.features.ruler import (
    Edges as Edges,
)
from .matching.features.ruler import (
    RulerEdges as RulerEdges,
)
from .matching.features.ruler import (
    best_smoothing as best_smoothing,
)
from .matching.features.selection import (
    Selection as Selection,
)
from .matching.field.distance_map import (
    DistanceMap as DistanceMap,
)
from .matching.field.distance_map import (
    Field as Field,
)
from .matching.field.field_pose import (
    FieldPoseRefinement as FieldPoseRefinement,
)
from .matching.field.field_pose import (
    FieldPoseSearch as FieldPoseSearch,
)
from .matching.field.field_pose import (
    PoseCandidate as PoseCandidate,
)
from .matching.field.located_robot import (
    LocatedRobot as LocatedRobot,
)
from .matching.field.odometry import (
    PoseEstimate as PoseEstimate,
)
from .matching.field.robot_filter import (
    RobotFilter as RobotFilter,
)
from .matching.pose.board_pose import (
    BoardPoseEstimate as BoardPoseEstimate,
)
from .matching.pose.board_pose import (
    BoardPoseEstimator as BoardPoseEstimator,
)
from .matching.pose.board_pose import (
    place_rulers as place_rulers,
)
from .matching.pose.bound_features import (
    BoundFeatures as BoundFeatures,
)
from .matching.pose.feature_pose import (
    EstimateFeaturePose as EstimateFeaturePose,
)
from .matching.pose.feature_pose import (
    FeaturePose as FeaturePose,
)
from .matching.pose.pose import (
    BoardPose as BoardPose,
)
from .matching.pose.pose import (
    SolvePose as SolvePose,
)
from .matching.pose.pose import (
    line_rows as line_rows,
)
from .matching.pose.pose import (
    point_rows as point_rows,
)
from .matching.pose.registration import (
    CoarseRegistration as CoarseRegistration,
)
from .matching.pose.registration import (
    Registration as Registration,
)
from .matching.pose.registration import (
    prepare_board_registration as prepare_board_registration,
)
from .matching.pose.registration import (
    register_images as register_images,
)
from .plots.simulation import (
    PictureScale as PictureScale,
)
from .ranging.height_map import (
    Grid as Grid,
)
from .ranging.height_map import (
    HeightMap as HeightMap,
)
from .ranging.line import (
    LineReadout as LineReadout,
)
from .ranging.line_parameters import (
    LineReading as LineReading,
)
from .ranging.merge_heights import (
    MergedHeights as MergedHeights,
)
from .ranging.merge_heights import (
    MergeHeights as MergeHeights,
)
from .ranging.merge_heights import (
    merge_height_maps as merge_height_maps,
)
from .ranging.psd import (
    PsdNoise as PsdNoise,
)
from .ranging.psd import (
    PsdReading as PsdReading,
)
from .ranging.psd import (
    PsdReadout as PsdReadout,
)
from .ranging.psd import (
    clipping_bias as clipping_bias,
)
from .ranging.range_image import (
    RangeImage as RangeImage,
)
from .ranging.range_image import (
    RangePoints as RangePoints,
)
from .ranging.regrid import (
    Regrid as Regrid,
)
from .ranging.rotating_sigma import (
    RotatingSheetSigma as RotatingSheetSigma,
)
from .ranging.sensor_geometry import (
    SensorGeometry as SensorGeometry,
)
from .ranging.sheet import (
    BentSheet as BentSheet,
)
from .ranging.sheet import (
    SampleAxes as SampleAxes,
)
from .ranging.sheet import (
    SheetPoints as SheetPoints,
)
from .ranging.sheet_calibration import (
    fit_sheet as fit_sheet,
)
from .ranging.sheet_from_points import (
    sheet_from_points as sheet_from_points,
)
from .ranging.sheet_motion import (
    RotatingSheet as RotatingSheet,
)
from .ranging.sheet_motion import (
    StraightTransport as StraightTransport,
)
from .ranging.sheet_readings import (
    LaserLine as LaserLine,
)
from .ranging.sheet_result import (
    SheetFit as SheetFit,
)
from .ranging.transport_calibration import (
    TransportFit as TransportFit,
)
from .ranging.transport_calibration import (
    fit_transport as fit_transport,
)
from .ranging.triangulation import (
    Triangulation as Triangulation,
)
from .servoing.axis import (
    Axis as Axis,
)
from .servoing.axis import (
    FineStage as FineStage,
)
from .servoing.controllers import (
    PidController as PidController,
)
from .servoing.controllers import (
    PidGains as PidGains,
)
from .servoing.controllers import (
    SmithPredictor as SmithPredictor,
)
from .servoing.delay import (
    DelayBudget as DelayBudget,
)
from .servoing.delay import (
    gain_limit as gain_limit,
)
from .servoing.delay import (
    non_oscillating_gain as non_oscillating_gain,
)
from .servoing.delay_measurement import (
    measure_delay as measure_delay,
)
from .servoing.guard import (
    LoopLimits as LoopLimits,
)
from .servoing.guard import (
    Outcome as Outcome,
)
from .servoing.loop import (
    ServoLoop as ServoLoop,
)
from .servoing.loop import (
    SimulatedClock as SimulatedClock,
)
from .servoing.loop import (
    WallClock as WallClock,
)
from .servoing.low_latency import (
    low_latency as low_latency,
)
from .servoing.observer import (
    MotionModel as MotionModel,
)
from .servoing.observer import (
    PoseMeasurement as PoseMeasurement,
)
from .servoing.observer import (
    PoseObserver as PoseObserver,
)
from .servoing.plant import (
    SimulatedPlant as SimulatedPlant,
)
from .servoing.settling import (
    VibrationSettling as VibrationSettling,
)
from .servoing.simulated_sensor import (
    SimulatedPoseSensor as SimulatedPoseSensor,
)
from .simulation.board_image.board_image import (
    BoardImage as BoardImage,
)
from .simulation.board_image.board_image import (
    RenderBoard as RenderBoard,
)
from .simulation.board_image.board_image import (
    exposure_poses as exposure_poses,
)
from .simulation.board_image.reflectance_map import (
    ReflectanceMap as ReflectanceMap,
)
from .simulation.errors.error_attribution import (
    ErrorAttribution as ErrorAttribution,
)
from .simulation.errors.error_attribution import (
    attribute_errors as attribute_errors,
)
from .simulation.errors.sensor_fusion import (
    SensorFusion as SensorFusion,
)
from .simulation.light_paths import (
    LightPaths as LightPaths,
)
from .simulation.scene.material import (
    Material as Material,
)
from .simulation.scene.rays import (
    AnyHit as AnyHit,
)
from .simulation.scene.rays import (
    ClosestHit as ClosestHit,
)
from .simulation.scene.reflectance import (
    Ggx as Ggx,
)
from .simulation.scene.reflectance import (
    Lambert as Lambert,
)
from .simulation.scene.reflectance import (
    OrenNayar as OrenNayar,
)
from .simulation.scene.reflectance import (
    Phong as Phong,
)
from .simulation.scene.reflectance import (
    Reflectance as Reflectance,
)
from .simulation.scene.reflectance import (
    Ward as Ward,
)
from .simulation.scene.scene import (
    Scene as Scene,
)
from .simulation.sensors.camera_simulator import (
    CameraSimulator as CameraSimulator,
)
from .simulation.sensors.masks import (
    Mask as Mask,
)
from .simulation.sensors.masks import (
    optimise_mask as optimise_mask,
)
from .simulation.sensors.psd_simulator import (
    PsdSimulator as PsdSimulator,
)
from .simulation.sensors.sensor_view import (
    SensorView as SensorView,
)
from .simulation.transport.illumination import (
    LightSheet as LightSheet,
)
from .simulation.transport.line_irradiance import (
    LineIrradiance as LineIrradiance,
)
from .simulation.transport.line_irradiance import (
    LitSegments as LitSegments,
)
from .simulation.transport.occluded_irradiance import (
    OccludedIrradiance as OccludedIrradiance,
)
from .simulation.transport.radiosity import (
    Radiosity as Radiosity,
)
from .status import (
    Status as Status,
)
from .workflows.planning import (
    LocationJob as LocationJob,
)
from .workflows.planning import (
    PlacementJob as PlacementJob,
)
from .workflows.planning import (
    ScanJob as ScanJob,
)
from .workflows.planning import (
    SimulationJob as SimulationJob,
)
from .workflows.planning import (
    plan as plan,
)

__version__: str
