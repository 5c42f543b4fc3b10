"""What the DICOM standard requires of MR images, as tables: PS3.3, information objects."""

# Type 1 (present, with a value) and type 2 (present) attributes of the mandatory modules, and
# those of type 1C and 2C whose condition an original, gated, one-echo image fulfils:
# DICOM PS3.3, tables A.4-1 and A.36-1 and the modules' own tables.
SHARED_MODULES = {
    "C.7.1.1 Patient": (
        "",
        "PatientName PatientID PatientBirthDate PatientSex",
    ),
    "C.7.2.1 General Study": (
        "StudyInstanceUID",
        "StudyDate StudyTime ReferringPhysicianName StudyID AccessionNumber",
    ),
    "C.7.3.1 General Series": ("Modality SeriesInstanceUID", "SeriesNumber PatientPosition"),
    "C.7.4.1 Frame of Reference": ("FrameOfReferenceUID", "PositionReferenceIndicator"),
    "C.7.5.1 General Equipment": ("", "Manufacturer"),
    "C.7.6.3 Image Pixel": (
        "SamplesPerPixel PhotometricInterpretation Rows Columns BitsAllocated BitsStored HighBit "
        "PixelRepresentation PixelData",
        "",
    ),
    "C.12.1 SOP Common": ("SOPClassUID SOPInstanceUID SpecificCharacterSet", ""),
}
CLASSIC_MODULES = SHARED_MODULES | {
    "C.7.6.1 General Image": ("", "InstanceNumber ContentDate ContentTime"),
    "C.7.6.2 Image Plane": (
        "PixelSpacing ImageOrientationPatient ImagePositionPatient",
        "SliceThickness",
    ),
    "C.8.3.1 MR Image": (
        "ImageType ScanningSequence SequenceVariant",
        "ScanOptions MRAcquisitionType RepetitionTime EchoTime EchoTrainLength TriggerTime",
    ),
}
ENHANCED_MODULES = SHARED_MODULES | {
    "C.7.5.2 Enhanced General Equipment": (
        "Manufacturer ManufacturerModelName DeviceSerialNumber SoftwareVersions",
        "",
    ),
    "C.7.6.16 Multi-frame Functional Groups": (
        "SharedFunctionalGroupsSequence PerFrameFunctionalGroupsSequence InstanceNumber "
        "ContentDate ContentTime NumberOfFrames",
        "",
    ),
    "C.7.6.17 Multi-frame Dimension": ("DimensionOrganizationSequence DimensionIndexSequence", ""),
    "C.7.6.14 Acquisition Context": ("", "AcquisitionContextSequence"),
    "C.7.6.18.1 Cardiac Synchronization": (
        "CardiacSynchronizationTechnique CardiacSignalSource CardiacRRIntervalSpecified "
        "CardiacBeatRejectionTechnique",
        "LowRRValue HighRRValue IntervalsAcquired IntervalsRejected",
    ),
    "C.7.6.18.2 Respiratory Synchronization": (
        "RespiratoryMotionCompensationTechnique RespiratorySignalSource",
        "",
    ),
    "C.8.13.1 Enhanced MR Image": (
        "AcquisitionDateTime AcquisitionDuration ResonantNucleus KSpaceFiltering "
        "MagneticFieldStrength ApplicableSafetyStandardAgency ImageType PixelPresentation "
        "VolumetricProperties VolumeBasedCalculationTechnique ComplexImageComponent "
        "AcquisitionContrast ContentQualification BurnedInAnnotation LossyImageCompression "
        "PresentationLUTShape",
        "",
    ),
    "C.8.13.4 MR Pulse Sequence": (
        "PulseSequenceName MRAcquisitionType EchoPulseSequence MultiPlanarExcitation "
        "PhaseContrast TimeOfFlightContrast SteadyStatePulseSequence EchoPlanarPulseSequence "
        "SaturationRecovery SpectrallySelectedSuppression OversamplingPhase "
        "GeometryOfKSpaceTraversal RectilinearPhaseEncodeReordering SegmentedKSpaceTraversal",
        "",
    ),
}
# Table A.36-2, the functional groups of an original, cardiac-gated frame, and their attributes
# (C.7.6.16.2 and C.8.13.5).
FUNCTIONAL_GROUPS = {
    "PixelMeasuresSequence": "PixelSpacing SliceThickness",
    "FrameContentSequence": (
        "FrameReferenceDateTime FrameAcquisitionDateTime FrameAcquisitionDuration "
        "DimensionIndexValues StackID InStackPositionNumber TemporalPositionIndex"
    ),
    "PlanePositionSequence": "ImagePositionPatient",
    "PlaneOrientationSequence": "ImageOrientationPatient",
    "CardiacSynchronizationSequence": (
        "NominalPercentageOfCardiacPhase NominalCardiacTriggerDelayTime RRIntervalTimeNominal"
    ),
    "FrameAnatomySequence": "FrameLaterality AnatomicRegionSequence",
    "PixelValueTransformationSequence": "RescaleIntercept RescaleSlope RescaleType",
    "FrameVOILUTSequence": "WindowCenter WindowWidth",
    "MRImageFrameTypeSequence": (
        "FrameType PixelPresentation VolumetricProperties VolumeBasedCalculationTechnique "
        "ComplexImageComponent AcquisitionContrast"
    ),
    "MRTimingAndRelatedParametersSequence": (
        "RepetitionTime FlipAngle EchoTrainLength RFEchoTrainLength GradientEchoTrainLength "
        "SpecificAbsorptionRateSequence GradientOutputType GradientOutput OperatingModeSequence"
    ),
    "MRFOVGeometrySequence": (
        "InPlanePhaseEncodingDirection MRAcquisitionFrequencyEncodingSteps "
        "MRAcquisitionPhaseEncodingStepsInPlane PercentSampling PercentPhaseFieldOfView"
    ),
    "MREchoSequence": "EffectiveEchoTime",
    "MRModifierSequence": (
        "InversionRecovery FlowCompensation Spoiling T2Preparation SpectrallySelectedExcitation "
        "SpatialPresaturation PartialFourier ParallelAcquisition"
    ),
    "MRImagingModifierSequence": (
        "MagnetizationTransfer BloodSignalNulling Tagging TransmitterFrequency PixelBandwidth"
    ),
    "MRReceiveCoilSequence": "ReceiveCoilName ReceiveCoilType QuadratureReceiveCoil",
    "MRTransmitCoilSequence": "TransmitCoilName TransmitCoilType",
    "MRAveragesSequence": "NumberOfAverages",
}
