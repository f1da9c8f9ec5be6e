"""The stages and options of PDAL (2.2 to 2.10) that read and write what a pipeline names, and run no code.

An allow list: what it does not name is refused unless code is allowed. So no option of another PDAL, and none
that PDAL does not list itself (``plugin`` loads any shared library), is let through for not being known. Left
out on purpose are ``log``, ``option_file``, ``reader_args`` (options of other stages,
past every check), the options that write files outside the set of outputs, and ``filters.csf``, which writes
some of its own into the current folder, whatever its options.
"""

from __future__ import annotations

from collections.abc import Mapping

_COMMON = "user_data where where_merge"
_READERS = "filename count override_srs default_srs spatialreference nosrs"

_OPTIONS = {
    "readers.bpf": "fix_dims",
    "readers.buffer": "",
    "readers.copc": (
        "bounds polygon ogr resolution header query requests keep_alive threads vlr fix_dims "
        "srs_vlr_order nosrs"
    ),
    "readers.draco": "",
    "readers.e57": "extra_dims",
    "readers.ept": (
        "bounds origin threads requests resolution addons polygon header query ogr ignore_unreadable"
    ),
    "readers.faux": "bounds mean_x mean_y mean_z stdev_x stdev_y stdev_z mode number_of_returns seed",
    "readers.fbi": "",
    "readers.gdal": "header memorycopy gdalopts",
    "readers.hdf": "dimensions",
    "readers.ilvis2": "mapping metadata",
    "readers.las": (
        "extra_dims compression use_eb_vlr ignore_vlr ignore_missing_vlrs fix_dims start nosrs threads "
        "srs_vlr_order srs_consume_preferred"
    ),
    "readers.mbio": "datatype format timegap speedmin",
    "readers.nitf": "extra_dims compression use_eb_vlr ignore_vlr fix_dims start nosrs threads",
    "readers.obj": "",
    "readers.optech": "",
    "readers.pcd": "fix_dims",
    "readers.ply": "fix_dims",
    "readers.pts": "fix_dims",
    "readers.ptx": "discard_missing_points",
    "readers.qfit": "flip_coordinates scale_z",
    "readers.rdb": "filter extras",
    "readers.sbet": "angles_as_degrees",
    "readers.smrmsg": "",
    "readers.spz": "",
    "readers.terrasolid": "",
    "readers.text": "separator header skip fix_dims",
    "readers.i3s": "bounds threads dimensions min_density max_density",
    "readers.pgpointcloud": "connection table schema column where srid",
    "readers.stac": (
        "asset_names date_ranges bounds ogr items catalogs collections validate_schema properties "
        "catalog_schema_url collection_schema_url feature_schema_url threads header query"
    ),
    "readers.slpk": "bounds threads dimensions min_density max_density",
    "readers.tiledb": (
        "array_name config_file chunk_size stats bbox start_timestamp end_timestamp timestamp strict"
    ),
    "readers.tindex": "lyr_name srs_column tindex_name sql bounds polygon t_srs filter_srs where dialect",
    "filters.approximatecoplanar": "knn thresh1 thresh2",
    "filters.assign": "assignment condition value",
    "filters.chipper": "capacity",
    "filters.cluster": "min_points max_points tolerance is3d",
    "filters.colorinterp": "dimension minimum maximum clamp ramp invert mad mad_multiplier k",
    "filters.colorization": "raster dimensions",
    "filters.covariancefeatures": "knn threads feature_set stride radius min_k mode optimized",
    "filters.cpd": "method",
    "filters.crop": "outside a_srs bounds point distance polygon ogr",
    "filters.dbscan": "min_points eps dimensions",
    "filters.decimation": "step offset limit",
    "filters.delaunay": "",
    "filters.dem": "limits raster band",
    "filters.divider": "mode count capacity expression",
    "filters.eigenvalues": "knn normalize stride radius min_k",
    "filters.elm": "cell class threshold",
    "filters.estimaterank": "knn thresh",
    "filters.expression": "expression",
    "filters.expressionstats": "dimension expressions",
    "filters.faceraster": "resolution origin_x origin_y width height mesh nodata max_triangle_edge_length",
    "filters.ferry": "dimensions",
    "filters.fps": "count",
    "filters.geomdistance": "dimension geometry ogr ring",
    "filters.gpstimeconvert": "in_time out_time conversion start_date wrap wrapped",
    "filters.greedyprojection": "multiplier radius num_neighbors min_angle max_angle eps_angle",
    "filters.griddecimation": "output_type resolution value",
    "filters.gridDecimation": "output_type resolution value",
    "filters.groupby": "dimension",
    "filters.h3": "resolution",
    "filters.hag_delaunay": "count allow_extrapolation class",
    "filters.hag_dem": "raster band zero_ground class",
    "filters.hag_nn": "count max_distance allow_extrapolation delaunay class",
    "filters.head": "count invert",
    "filters.hexbin": (
        "sample_size threshold output_tesselation edge_size edge_length precision "
        "hole_cull_area_tolerance smooth preserve_topology h3_grid h3_resolution"
    ),
    "filters.icp": "max_iter rt tt mse_abs max_similar max_dist init",
    "filters.info": "point query",
    "filters.iqr": "k dimension",
    "filters.label_duplicates": "dimensions",
    "filters.litree": "min_points min_height radius",
    "filters.lloydkmeans": "k dimensions maxiters",
    "filters.locate": "dimension minmax",
    "filters.lof": "minpts",
    "filters.m3c2": "normal_radius cyl_radius cyl_halflen reg_error orientation min_points samples",
    "filters.mad": "k dimension mad_multiplier",
    "filters.merge": "",
    "filters.miniball": "knn threads",
    "filters.mongo": "expression",
    "filters.mongoexpression": "expression",
    "filters.mortonorder": "reverse",
    "filters.neighborclassifier": "domain k candidate dimension",
    "filters.nndistance": "mode k",
    "filters.normal": "knn radius viewpoint always_up refine",
    "filters.optimalneighborhood": "min_k max_k",
    "filters.outlier": "method min_k radius mean_k multiplier class",
    "filters.overlay": "dimension datasource column query layer bounds threads",
    "filters.planefit": "knn threads",
    "filters.pmf": "cell_size exponential ignore initial_distance returns max_distance max_window_size slope",
    "filters.poisson": "density depth",
    "filters.projpipeline": "out_srs reverse_transfo coord_op",
    "filters.radialdensity": "radius",
    "filters.radiusassign": (
        "radius src_domain reference_domain update_expression is3d max2d_above max2d_below"
    ),
    "filters.randomize": "seed",
    "filters.range": "limits",
    "filters.reciprocity": "knn threads",
    "filters.relaxationdartthrowing": "decay radius count shuffle seed",
    "filters.reprojection": (
        "out_srs in_srs in_axis_ordering out_axis_ordering in_coord_epoch out_coord_epoch error_on_failure"
    ),
    "filters.returns": "groups",
    "filters.sample": "radius cell origin_x origin_y origin_z dimension",
    "filters.separatescanline": "groupby",
    "filters.skewnessbalancing": "",
    "filters.smrf": "cell slope scalar threshold cut ignore returns classbits window",
    "filters.sort": "dimension dimensions order algorithm",
    "filters.sparsesurface": "radius",
    "filters.splitter": "length origin_x origin_y buffer",
    "filters.stats": "dimensions enumerate global count advanced",
    "filters.straighten": "polyline offset reverse",
    "filters.supervoxel": "knn resolution",
    "filters.tail": "count invert",
    "filters.teaser": "nr nv fpfh",
    "filters.trajectory": "dtr dst minsep accel tblock tout niter multiplier",
    "filters.transformation": "invert matrix override_srs",
    "filters.voxelcenternearestneighbor": "cell",
    "filters.voxelcentroidnearestneighbor": "cell",
    "filters.voxeldownsize": "cell mode",
    "filters.zsmooth": "radius medianpercent dim",
    "writers.bpf": (
        "compression header_data format coord_id output_dims offset_x offset_y offset_z scale_x scale_y "
        "scale_z auto_offset"
    ),
    "writers.copc": (
        "forward fixed_seed scale_x scale_y scale_z offset_x offset_y offset_z filesource_id system_id "
        "software_id creation_doy creation_year pipeline vlrs a_srs threads extra_dims enhanced_srs_vlrs "
        "global_encoding project_id"
    ),
    "writers.draco": "dimensions quantization",
    "writers.e57": "doublePrecision extra_dims",
    "writers.fbi": "",
    "writers.gdal": (
        "resolution radius power gdaldriver gdalopts output_type window_size dimension bounds origin_x "
        "origin_y width height nodata data_type override_srs default_srs metadata pdal_metadata binmode"
    ),
    "writers.gltf": "metallic roughness red green blue alpha double_sided color_vertices normals",
    "writers.las": (
        "a_srs compression discard_high_return_numbers extra_dims forward filesource_id major_version "
        "minor_version dataformat_id format global_encoding project_id system_id software_id creation_doy "
        "creation_year pdal_metadata scale_x scale_y scale_z offset_x offset_y offset_z vlrs "
        "enhanced_srs_vlrs threads spatialreference"
    ),
    "writers.null": "",
    "writers.ogr": "multicount measure_dim attr_dims ogrdriver ogr_options",
    "writers.pcd": "compression keep_unspecified order precision",
    "writers.pgpointcloud": (
        "connection table schema column compression overwrite srid pcid pre_sql post_sql scale_x scale_y "
        "scale_z offset_x offset_y offset_z output_dims"
    ),
    "writers.ply": "storage_mode dims faces sized_types precision",
    "writers.raster": "gdaldriver gdalopts rasters nodata data_type",
    "writers.sbet": "angles_are_degrees",
    "writers.spz": "antialiased",
    "writers.text": (
        "format order keep_unspecified jscallback quote_header write_header newline delimiter precision"
    ),
    "writers.tiledb": (
        "array_name config_file data_tile_capacity x_tile_size y_tile_size z_tile_size time_tile_size "
        "x_domain_st x_domain_end y_domain_st y_domain_end z_domain_st z_domain_end compression "
        "compression_level stats filters append use_time chunk_size combine_bit_fields"
    ),
}


def _complete(kind: str, own: str) -> frozenset[str]:
    more = {"readers": _READERS, "writers": "filename"}.get(kind.partition(".")[0], "")
    return frozenset(f"{_COMMON} {more} {own}".split())


ALLOWED: Mapping[str, frozenset[str]] = {kind: _complete(kind, own) for kind, own in _OPTIONS.items()}
"""The options of each allowed stage, by its type."""

REFUSED: Mapping[str, str] = {
    "writers.ept_addon": "it writes folders that do not come into place with the other outputs",
    "filters.streamcallback": "it has no use in a pipeline file",
    "readers.memoryview": "clouds in memory are given from Python, by arrays=",
}
"""Stages that are refused whatever is allowed, and why."""

ONE_FILE: Mapping[tuple[str, str], frozenset[str]] = {
    ("writers.gdal", "gdaldriver"): frozenset({"gtiff"}),
    ("writers.raster", "gdaldriver"): frozenset({"gtiff"}),
    ("writers.ogr", "ogrdriver"): frozenset({"geojson", "geojsonseq", "gpkg", "flatgeobuf", "kml", "gml"}),
}
"""Drivers, in small letters, that leave one file: companions of others would not come into place with it."""
